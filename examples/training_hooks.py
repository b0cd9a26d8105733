"""Hooks for ``edgeslam finetune``: copy what you need, change it, and name it on the command line.

    edgeslam finetune FLIGHT --out tuned --hook training_hooks.py:OwnLoss --hook training_hooks.py:stop

``docs/guides/your-own-loop.md`` lists the events, and what may be read and changed in each.
"""

import csv
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np
import torch

from edgeslam_torch.losses import SmoothnessLoss
from edgeslam_torch.train import Drawn, Hooks, TrainConfig, TrainState, rank


class OwnLoss(Hooks):
    """Another term: planes where the image is smooth."""

    def __init__(self, weight: float = 0.05) -> None:
        self.weight, self.smooth = weight, SmoothnessLoss()

    def on_losses(self, state: TrainState, drawn: Drawn) -> None:
        """One value an image, as the other losses."""
        images = drawn.batch["image"]
        grey = images.mean(1, keepdim=True).expand(-1, 3, -1, -1) * 0.25  # normalised colours, about [0, 1] wide
        value = self.smooth(drawn.predicted.log_depth, grey)
        of_images = next(iter(drawn.losses.values())).shape[0]  # pairs have two images and one loss
        drawn.losses["smooth"] = self.weight * value[:of_images]


class CsvLog(Hooks):
    """Losses of every step as a table."""

    def __init__(self, path: str = "losses.csv") -> None:
        self.path = Path(path)
        self.file: TextIO | None = None

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Open the file; a resumed training goes on in it."""
        if rank() == 0:
            self.file = self.path.open("a" if state.step else "w", newline="")

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """A row: step, name, value."""
        if self.file is not None:
            csv.writer(self.file).writerows((state.step, name, f"{value:.6g}") for name, value in losses.items())

    def close(self) -> None:
        """Also after an error, and then perhaps before the start."""
        if self.file is not None:
            self.file.close()


class EarlyStop(Hooks):
    """End as soon as one metric is good enough."""

    def __init__(self, metric: str = "abs_rel", below: float = 0.05) -> None:
        self.metric, self.below = metric, below

    def on_validation(self, state: TrainState, metrics: dict[str, float]) -> None:
        """Writing a reason is all it takes."""
        if metrics.get(self.metric, np.inf) < self.below:
            state.stop = f"{self.metric} is below {self.below:g}"


class SampleImages(Hooks):
    """Depth of some images of the batch as PNG files, every now and then."""

    def __init__(self, folder: str = "samples", every: int = 50) -> None:
        self.folder, self.every = Path(folder), every

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """Nearer is brighter."""
        if state.step % self.every or state.shown is None or rank() != 0:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        with torch.no_grad():
            inverse = torch.exp(-state.averaged.predict(state.shown).log_depth)[:, 0].numpy()
        for k, picture in enumerate(inverse):
            level = (255.0 * picture / picture.max()).astype(np.uint8)
            cv2.imwrite(str(self.folder / f"{state.step:06}-{k}.png"), level)


stop = EarlyStop(metric="abs_rel_scaled", below=0.04)
"""An instance can be named as well: this is how a hook of the command line gets arguments."""
