"""Fine-tuning on recordings with depth, without, or both."""

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.augment import View
from edgeslam_torch.train.datasets import DepthFolder
from edgeslam_torch.train.distributed import rank
from edgeslam_torch.train.posed import PosedSequence, PosedView
from edgeslam_torch.train.recipe import Hooks, TrainConfig, train
from edgeslam_torch.train.self_supervised import SelfSupervised, fit_log_scale
from edgeslam_torch.train.signals import Signal, Source, Supervised
from edgeslam_torch.train.teacher import teach
from edgeslam_torch.train.validate import DepthScores, predict_metres, score
from edgeslam_torch.train.watchers import ProgressBar, TensorBoard

logger = logging.getLogger(__name__)

HELD_OUT = 10
"""Every tenth labelled view validates when nothing else was given."""


class FromRuns(StrEnum):
    """What is learnt from images without labels."""

    TEACHER = "teacher"
    """Dense depth measured with the run's poses: the best, and four times as fast as pairs (docs/model_card.md)."""
    PAIRS = "pairs"
    """Losses on pairs of images: photometric, map points, cycle, L-shape."""
    BOTH = "both"


@dataclass
class Data:
    """What to learn from."""

    labelled: list[DepthFolder] = field(default_factory=list)
    posed: list[PosedSequence] = field(default_factory=list)
    validation: list[DepthFolder] = field(default_factory=list)

    def describe(self) -> list[str]:
        """One line per folder, and the files left out."""
        lines = [f"{f.name}: {len(f.views)} images with depth" for f in self.labelled]
        lines += [f"{s.name}: {len(s.usable)} posed images without depth" for s in self.posed]
        for folder in (*self.labelled, *self.validation):
            lines += [f"left out, unreadable: {name}" for name in folder.unreadable]
        return lines


@dataclass(frozen=True, slots=True)
class Result:
    """What fine-tuning changed."""

    weights: Path
    before: DepthScores | None
    after: DepthScores | None
    """On the validation views; None when there are none with depth."""

    def describe(self) -> str:
        """A short table."""
        if self.before is None or self.after is None:
            return f"{self.weights} (no depth to validate on)"
        rows = ["| | AbsRel | AbsRel, median scaled | delta1 |", "|---|---|---|---|"]
        for name, s in (("before", self.before), ("after", self.after)):
            rows.append(f"| {name} | {s.abs_rel:.4f} | {s.abs_rel_scaled:.4f} | {s.delta1:.4f} |")
        return "\n".join([*rows, str(self.weights)])


def finetune(
    network: FastDepth,
    metadata: Metadata,
    data: Data,
    config: TrainConfig,
    out: Path,
    from_runs: FromRuns = FromRuns.TEACHER,
) -> Result:
    """Train ``network`` on ``data``; resumes a run that was killed.

    Raises:
        SourceError: If there is nothing to learn from.
        NonFiniteLossError: If a loss is not finite.
    """
    labelled, held_out = _split(data)
    signals = build_signals(network, metadata, data.posed, labelled, from_runs)
    if not signals:
        raise SourceError("nothing to learn from: no images with depth and no run with poses")
    names = tuple(dict.fromkeys([*metadata.data, *(f.name for f in data.labelled), *(s.name for s in data.posed)]))
    metadata = dataclasses.replace(
        metadata,
        data=names,
        metrics={},
        licence=f"{metadata.licence}; fine-tuned on the user's data",
        notes="edgeslam finetune",
    )
    before = score(network, metadata, held_out) if held_out and rank() == 0 else None
    hooks: list[Hooks] = []
    if rank() == 0:
        hooks = [ProgressBar(), TensorBoard(out / "tensorboard", metadata, _pictures(data, labelled))]

    def validate(averaged: FastDepth) -> dict[str, float]:
        if not held_out:
            return {"score": 0.0}
        scores = dataclasses.asdict(score(averaged, metadata, held_out))
        return {"score": scores["abs_rel_scaled"], **scores}

    train(network, metadata, signals, config, out, validate, hooks)
    weights = out / ("best.safetensors" if held_out and config.patience else "final.safetensors")
    tuned, _ = load_checkpoint(weights)
    after = score(tuned, metadata, held_out) if held_out and rank() == 0 else None
    if rank() == 0:
        metrics = {k: round(v, 4) for k, v in dataclasses.asdict(after).items()} if after is not None else {}
        save_checkpoint(tuned, dataclasses.replace(metadata, metrics=metrics), out / "weights.safetensors", half=True)
    return Result(out / "weights.safetensors", before, after)


def build_signals(
    network: FastDepth,
    metadata: Metadata,
    posed: Sequence[PosedSequence],
    labelled: Sequence[Source],
    from_runs: FromRuns = FromRuns.TEACHER,
) -> list[Signal]:
    """One signal per kind of data; runs in arbitrary units are scaled to the network's own depth."""
    signals: list[Signal] = []
    if labelled:
        signals.append(Supervised(labelled, metadata))
    usable = [s for s in posed if s.usable]
    if usable:
        scales = [0.0 if s.metric else fit_log_scale(*_points_and_depths(network, metadata, s)) for s in usable]
        if from_runs is not FromRuns.PAIRS:
            taught = [Source(s.name, teach(network, metadata, s, k), 1.0) for s, k in zip(usable, scales, strict=True)]
            signals.append(Supervised(taught, metadata, name="teacher"))
        if from_runs is not FromRuns.TEACHER:
            signals.append(SelfSupervised(usable, metadata, scales))
    return signals


def _points_and_depths(
    network: FastDepth, metadata: Metadata, sequence: PosedSequence, most: int = 24
) -> tuple[list[PosedView], list[np.ndarray]]:
    """Some views, and the network's log depth at their map points."""
    network.eval()
    chosen = np.linspace(0, len(sequence.views) - 1, min(most, len(sequence.views))).astype(int)
    views = [sequence.views[int(i)] for i in chosen]
    return views, [_at_points(network, metadata, v) for v in views]


def _at_points(network: FastDepth, metadata: Metadata, view: PosedView) -> np.ndarray:
    depth, _ = predict_metres(network, metadata, View(view.image, np.zeros(view.image.shape[:2], np.float32), view.K))
    return np.log(map_coordinates(depth, view.uv[:, ::-1].T, order=1, mode="nearest"))


def _split(data: Data) -> tuple[list[Source], list[View]]:
    """Training sources and validation views."""
    if data.validation:
        return [Source(f.name, f.views, 1.0) for f in data.labelled], [v for f in data.validation for v in f.views]
    held_out = [v for f in data.labelled for v in f.views[::HELD_OUT]]
    sources = []
    for folder in data.labelled:
        kept = [v for i, v in enumerate(folder.views) if i % HELD_OUT]
        sources.append(Source(folder.name, kept or folder.views, 1.0))
    return sources, held_out


def _pictures(data: Data, labelled: Sequence[Source]) -> list[View]:
    """Up to four views for TensorBoard, those with depth first."""
    views = [f.views[len(f.views) // 2] for f in data.validation] + [s.views[len(s.views) // 2] for s in labelled]
    for sequence in data.posed:
        v = sequence.views[len(sequence.views) // 2]
        views.append(View(v.image, np.zeros(v.image.shape[:2], np.float32), v.K))
    return views[:4]
