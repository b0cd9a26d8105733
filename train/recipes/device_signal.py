"""Supervision from views that lie on the device, where a processor could not augment as fast as the device learns."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import Prediction
from edgeslam_torch.train.signals import Slot, SupervisedTerms, SupervisedWeights
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.batches import Views, joined, on_device, random_views
from edgeslam_torch.train.views.datasets import FAR_M, NEAR_M
from edgeslam_torch.train.views.rendered import stored_views

POOL_SIZE = (240, 320)
"""Height and width of the views that are kept on the device [px]."""


@dataclass
class Pool:
    """Views of one source on the device; `more`, where given, yields those that have come since."""

    name: str
    views: Views
    share: float
    """Part of the batch taken from here, relative to the other pools."""
    metric: float = 1.0
    """Weight of an image's mean log error: 1 supervises metric depth, 0 shape only."""
    more: Callable[[], Sequence[View]] | None = None


@dataclass
class Arriving:
    """Views of the files that a renderer still adds to a folder; each file is read once."""

    folder: Path
    read: set[Path] = field(default_factory=set)

    def __call__(self) -> list[View]:
        """Of at most one file, so that no step waits long."""
        for path in sorted(self.folder.glob("places_*.npz")):
            if path not in self.read:
                self.read.add(path)
                return stored_views(path)
        return []

    def wait(self, for_s: float = 300.0) -> list[View]:
        """As above, waiting for a file.

        Raises:
            SourceError: If none comes in that time.
        """
        until = time.monotonic() + for_s
        while time.monotonic() < until:
            if views := self():
                return views
            time.sleep(0.5)
        raise SourceError(f"{self.folder}: no places_*.npz came in {for_s:.0f} s")


class SupervisedOnDevice:
    """As `train.signals.Supervised`, from pools: a batch depends on the seed, the step and what the pools then hold."""

    name = "supervised"
    ASK_EVERY = 10
    """Steps between two questions for more."""

    def __init__(
        self, pools: Sequence[Pool], metadata: Metadata, augment: AugmentConfig, weights: SupervisedWeights
    ) -> None:
        self.pools, self.metadata, self.augment = pools, metadata, augment
        self._terms = SupervisedTerms(weights)
        shares = np.array([pool.share for pool in pools])
        self._shares = shares / shares.sum()

    def describe(self, slots: Sequence[Slot]) -> list[str]:
        """``pool/index`` of each image."""
        return [f"{self.pools[p].name}/{row}" for p, rows in self._chosen(slots) for row in rows]

    def _chosen(self, slots: Sequence[Slot]) -> Iterator[tuple[int, list[int]]]:
        """Rows of each pool in the batch."""
        rng = slots[0].rng()
        for p, count in enumerate(rng.multinomial(len(slots), self._shares)):
            yield p, rng.integers(len(self.pools[p].views), size=int(count)).tolist()

    def draw(self, slots: Sequence[Slot]) -> dict[str, Tensor]:
        """As `Supervised.draw`, on the device."""
        if slots[0].step % self.ASK_EVERY == 0:
            self._grow()
        chosen = [(p, rows) for p, rows in self._chosen(slots) if rows]
        views = joined([self.pools[p].views.of(rows) for p, rows in chosen])
        size = (self.metadata.input_height, self.metadata.input_width)
        rng = np.random.default_rng((slots[0].seed, slots[0].step, slots[0].index, 1))
        image, depth_m, focal_px = random_views(views, size, self.augment, rng)
        device = image.device
        depth = depth_m * torch.from_numpy(self.metadata.focal_px / focal_px).float().view(-1, 1, 1, 1).to(device)
        metric = np.repeat([self.pools[p].metric for p, _ in chosen], [len(rows) for _, rows in chosen])
        mean, std = (image.new_tensor(values).view(3, 1, 1) for values in (self.metadata.mean, self.metadata.std))
        return {
            "image": (image - mean) / std,
            "log_depth": depth.clamp(NEAR_M, FAR_M).log(),
            "mask": (depth > NEAR_M) & (depth < FAR_M),
            "metric": torch.from_numpy(metric).float().to(device),
        }

    def losses(self, predicted: Prediction, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weighted terms, each ``(B,)``."""
        return self._terms(predicted, batch)

    def _grow(self) -> None:
        for pool in self.pools:
            if pool.more is not None and (came := pool.more()):
                pool.views = joined([pool.views, on_device(came, POOL_SIZE, pool.views.image.device)])
