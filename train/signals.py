"""Sources of supervision: a signal draws its part of a batch and returns named losses."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.depth_terms import GradientMatching, LaplaceNll, LogSlope, MaskedL1, masked_mean
from edgeslam_torch.losses.total import TotalLoss
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import Prediction
from edgeslam_torch.train.validate import image_tensor
from edgeslam_torch.train.views.augment import AugmentConfig, View, random_view
from edgeslam_torch.train.views.datasets import FAR_M, NEAR_M


@dataclass(frozen=True, slots=True)
class Slot:
    """One image's place in the global batch of a step; all its randomness is derived from these three numbers."""

    seed: int
    step: int
    index: int

    def rng(self) -> np.random.Generator:
        """The slot's own generator: identical on every machine, after restarts and in any process."""
        return np.random.default_rng((self.seed, self.step, self.index))


class Signal(Protocol):
    """A kind of supervision."""

    name: str

    def draw(self, slots: Sequence[Slot]) -> tuple[dict[str, Tensor], list[str]]:
        """Tensors of a batch, one image per slot, and what each shows, for messages."""
        ...

    def losses(self, predicted: Prediction, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weighted losses by name, each ``(B,)``, of what the network predicts for ``batch["image"]``."""
        ...


@dataclass(frozen=True, slots=True)
class SupervisedWeights:
    """Weights of the supervised terms; 0 leaves one out."""

    l1: float = 1.0
    gradient: float = 0.5
    slope: float = 0.0
    """Against far depth that is predicted too near."""
    uncertainty: float = 0.1


class Views(Protocol):
    """Views in memory, or read when they are drawn."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> View: ...


@dataclass(frozen=True, slots=True)
class Source:
    """A pool of views drawn with equal chances."""

    name: str
    views: Views
    share: float
    """Part of the batch taken from here, relative to the other sources."""
    metric: float = 1.0
    """Weight of an image's mean log error: 1 supervises metric depth, 0 shape only."""


@dataclass
class Supervised:
    """Images with depth from several sources, augmented."""

    sources: Sequence[Source]
    metadata: Metadata
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    weights: SupervisedWeights = field(default_factory=SupervisedWeights)
    name: str = "supervised"

    def __post_init__(self) -> None:
        shares = np.array([s.share for s in self.sources], dtype=np.float64)
        self._edges = np.cumsum(shares / shares.sum())
        self._terms = {"l1": MaskedL1(), "gradient": GradientMatching(), "slope": LogSlope()}
        self._nll = LaplaceNll()

    def draw(self, slots: Sequence[Slot]) -> tuple[dict[str, Tensor], list[str]]:
        """``image (B, 3, H, W)``, ``log_depth (B, 1, H, W)`` at the training focal length, ``mask``,
        ``metric (B,)``; ``source/index`` of each image."""
        images, targets, metric, names = [], [], [], []
        size = (self.metadata.input_height, self.metadata.input_width)
        for slot in slots:
            rng = slot.rng()
            source = self.sources[min(int(np.searchsorted(self._edges, rng.random())), len(self.sources) - 1)]
            index = int(rng.integers(len(source.views)))
            view = random_view(source.views[index], size, self.augment, rng)
            images.append(image_tensor(view.image, self.metadata))
            metric.append(source.metric)
            focal = float(np.sqrt(view.K[0, 0] * view.K[1, 1]))
            targets.append(torch.from_numpy(view.depth_m * (self.metadata.focal_px / focal))[None])
            names.append(f"{source.name}/{index}")
        depth = torch.stack(targets)
        mask = (depth > NEAR_M) & (depth < FAR_M)
        log_depth = depth.clamp(NEAR_M, FAR_M).log()
        return {
            "image": torch.stack(images), "log_depth": log_depth, "mask": mask, "metric": torch.tensor(metric)
        }, names  # fmt: skip

    def losses(self, predicted: Prediction, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weighted terms, each ``(B,)``."""
        target, mask, weights = batch["log_depth"], batch["mask"], asdict(self.weights)
        # Part of the mean error is removed from the residual, including its gradient, leaving scale partly free.
        free = (1.0 - batch["metric"]) * masked_mean(predicted.log_depth - target, mask)
        target = target + free.view(-1, 1, 1, 1)
        terms = {n: term(predicted.log_depth, target, mask) for n, term in self._terms.items() if weights[n]}
        if predicted.log_sigma is not None and weights["uncertainty"]:
            terms["uncertainty"] = self._nll(predicted.log_sigma, predicted.log_depth, target, mask)
        return TotalLoss(weights).weighted(terms)
