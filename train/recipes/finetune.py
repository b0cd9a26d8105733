"""Fine-tuning on recordings with depth, without, or both."""

import copy
import dataclasses
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from torch.utils.data import Subset

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.models.checkpoint import restored, save_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.callbacks import ProgressBar, curves
from edgeslam_torch.train.folder import (
    HOOKS,
    TEACHER,
    TENSORBOARD,
    WEIGHTS,
    OutFolder,
    TrainingResult,
    content,
    contents,
    inputs,
    weights_name,
)
from edgeslam_torch.train.hooks import Hooks, changes_losses
from edgeslam_torch.train.loop import BEST, FINAL, train
from edgeslam_torch.train.processes.distributed import by_first, rank
from edgeslam_torch.train.self_supervised import SelfSupervised
from edgeslam_torch.train.signals import Signal, Source, Supervised, Views
from edgeslam_torch.train.state import TrainConfig, TrainState
from edgeslam_torch.train.teachers.teach import kept_depth, log_metres, teach
from edgeslam_torch.train.validate import DepthScores, calibrate_sigma, counted_pixels, metres_by, score
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.posed import PosedSequence

logger = logging.getLogger(__name__)

HELD_OUT, MOST_HELD_OUT = 10, 400
"""Every tenth view with depth is used for validation by default; at most 400, which stay in memory."""
OWN_DATA = "; fine-tuned on the user's data"


class FromRuns(StrEnum):
    """Supervision for images without labels."""

    TEACHER = "teacher"
    """Dense depth measured with the run's poses: most accurate, and four times as fast as pairs."""
    PAIRS = "pairs"
    """Losses on pairs of images: photometric, map points, cycle, L-shape."""
    BOTH = "both"


@dataclass
class Data:
    """Training data."""

    labelled: list[DepthFolder] = field(default_factory=list)
    posed: list[PosedSequence] = field(default_factory=list)
    validation: list[DepthFolder] = field(default_factory=list)

    def describe(self) -> list[str]:
        """One line per folder."""
        lines = [f"{f.name}: {len(f.views)} images with depth" for f in self.labelled]
        lines += [f"{s.name}: {len(s.usable)} posed images without depth" for s in self.posed]
        lines += [f"{f.name}: {len(f.views)} images to validate on" for f in self.validation]
        return lines

    def usable(self) -> "Data":
        """The data without runs that have no pair of images with a useful baseline.

        Raises:
            SourceError: If nothing is left.
        """
        posed = [s for s in self.posed if s.usable]
        if not (self.labelled or posed):
            raise SourceError(
                "no training data: no images with depth, and no run with two images of one place with a baseline"
            )
        for s in self.posed:
            if not s.usable:
                logger.warning("%s: no two images of one place with a baseline; not used", s.name)
        return Data(self.labelled, posed, self.validation)


def finetune(
    network: DepthModule,
    metadata: Metadata,
    data: Data,
    config: TrainConfig,
    out: OutFolder,
    from_runs: FromRuns = FromRuns.TEACHER,
    reading: Mapping[str, object] = MappingProxyType({}),
    hooks: Sequence[Hooks] = (),
    cache: Path | None = None,
    calibrate: bool = False,
) -> TrainingResult:
    """Train ``network`` on ``data``; resumes a training in ``out`` with the same inputs.

    ``out/weights.safetensors`` holds the best validated weights, including the initial ones; without validation data,
    the last ones.

    Args:
        network: To begin with; changed in place.
        metadata: Its record.
        data: What to learn from.
        config: Of the recipe.
        out: From `out_folder`.
        from_runs: What is learnt from images without labels.
        reading: How the data was read, plain values by name; a training is resumed only if they are the same.
        hooks: Your own, called after the progress and before TensorBoard, in every process.
        cache: Keeps the teacher's depth for other trainings; by default ``out`` keeps it for this one.
        calibrate: Fit scale and floor of sigma to the validation images: for networks whose uncertainty is new.

    Raises:
        SourceError: If there is nothing to learn from, or to validate on.
        ConfigError: If ``out`` holds another training, or a hook makes no losses of them.
        DivergedError: If a loss is not finite, or the network's depth becomes absurd.
        OSError: If the file cannot be written.
    """
    data = data.usable()
    sets = [(f.name, "depth") for f in data.labelled] + [(s.name, "run") for s in data.posed]
    given = inputs(
        (network, metadata),
        sets,
        [f.name for f in data.validation],
        settings_of(config, from_runs, reading, hooks),
    ) | contents([*data.labelled, *data.posed, *data.validation])
    if (done := by_first(lambda: out.finished(given))) is not None:
        return dataclasses.replace(done, nothing_to_do=True)
    by_first(lambda: out.begin(given))
    start = copy.deepcopy(network).eval()
    signals, held_out = _prepared(start, metadata, data, from_runs, cache or subfolder(out.path, TEACHER))
    before = by_first(lambda: score(start, metadata, held_out)) if held_out else None
    tuned = _tuned_metadata(metadata, data)
    watching = list(hooks)
    if rank() == 0:
        watching = [ProgressBar(), *hooks, *curves(subfolder(out.path, TENSORBOARD), tuned, _pictures(data, held_out))]

    state = train(
        network,
        tuned,
        signals,
        config,
        out.path,
        (lambda averaged: score(averaged, metadata, held_out).metrics()) if held_out else None,
        watching,
        None if before is None else before.metrics(),
    )
    return by_first(lambda: _conclude(state, start, metadata, tuned, before, held_out, out, calibrate))


def settings_of(
    config: TrainConfig, from_runs: FromRuns, reading: Mapping[str, object], hooks: Sequence[Hooks] = ()
) -> dict[str, Any]:
    """Settings by name, plain values, as ``finetune.json`` keeps them; those of hooks only where there are any."""
    named = {f"{type(hook).__module__}:{type(hook).__qualname__}": hook for hook in hooks}
    own = {HOOKS: sorted(named), "losses_of": sorted(name for name, hook in named.items() if changes_losses(hook))}
    return {**dataclasses.asdict(config), "from_runs": str(from_runs), **reading, **{k: v for k, v in own.items() if v}}


def _prepared(
    start: DepthModule, metadata: Metadata, data: Data, from_runs: FromRuns, kept_in: Path
) -> tuple[list[Signal], list[View]]:
    """Training signals, and the views to validate on.

    Runs in arbitrary units are scaled to the network's own depth. ``kept_in`` is where measured depth is kept.
    """
    signals: list[Signal] = []
    labelled, held_out = _split(data.labelled, keep_all=bool(data.validation))
    if labelled:
        signals.append(Supervised(labelled, metadata))
    if data.posed:
        own = metres_by(start, metadata)
        scales = [0.0 if s.metric else log_metres(own, s) for s in data.posed]
        if from_runs is not FromRuns.PAIRS:
            sources = []
            for sequence, scale in zip(data.posed, scales, strict=True):
                made_from = content(sequence), weights_name(start, metadata), scale
                taught = teach(own, sequence, scale, kept_depth(kept_in, sequence.name, *made_from))
                if not (data.validation or labelled):
                    for t in taught[::HELD_OUT]:
                        measured = np.where(t.measured, t.view.depth_m, 0.0)
                        held_out.append(dataclasses.replace(t.view, depth_m=measured))
                    taught = [t for i, t in enumerate(taught) if i % HELD_OUT]
                sources.append(Source(sequence.name, [t.view for t in taught], 1.0))
            signals.append(Supervised(sources, metadata, name="teacher"))
        if from_runs is not FromRuns.TEACHER:
            signals.append(SelfSupervised(data.posed, metadata, scales))
    if data.validation:
        return signals, [v for f in data.validation for v in f.views]
    return signals, [v for v in held_out if counted_pixels(v).any()]  # none, for a flight high above the ground


def _split(folders: Sequence[DepthFolder], keep_all: bool) -> tuple[list[Source], list[View]]:
    """Training sources, and every tenth view to validate on unless all are kept for training."""
    held_out: list[View] = []
    sources = []
    for folder in folders:
        views: Views = folder.views
        if not keep_all and len(views) > 1:
            every = max(HELD_OUT, math.ceil(len(views) / MOST_HELD_OUT))
            held_out += [views[i] for i in range(0, len(views), every)]
            # Those of shards are not read before they are drawn.
            views = Subset(views, [i for i in range(len(views)) if i % every])  # type: ignore[arg-type]
        sources.append(Source(folder.name, views, 1.0))
    return sources, held_out


def _tuned_metadata(metadata: Metadata, data: Data) -> Metadata:
    """The record of weights that learnt from ``data``."""
    names = [*metadata.data, *(f.name for f in data.labelled), *(s.name for s in data.posed)]
    return dataclasses.replace(
        metadata,
        data=tuple(dict.fromkeys(names)),
        metrics={},
        licence=metadata.licence if metadata.licence.endswith(OWN_DATA) else metadata.licence + OWN_DATA,
        notes="edgeslam finetune",
    )


def _conclude(
    state: TrainState,
    start: DepthModule,
    metadata: Metadata,
    tuned: Metadata,
    before: DepthScores | None,
    held_out: Sequence[View],
    out: OutFolder,
    calibrate: bool,
) -> TrainingResult:
    """Write the better weights with their metadata, and return the outcome."""
    path = out.path / WEIGHTS
    if before is None:
        outcome = TrainingResult(path, state.step)
        save_checkpoint(state.averaged, outcome.noted_in(tuned), path, half=True)
    elif state.best_step == 0:
        last = restored(start, out.path / FINAL)
        outcome = TrainingResult(path, state.step, 0, before, score(last, metadata, held_out), before)
        # Not converted to float16: the initial tensors with their own metadata.
        save_checkpoint(start, outcome.noted_in(metadata), path)
    else:
        last, best = (restored(start, out.path / name) for name in (FINAL, BEST))
        kept = score(best, metadata, held_out)
        outcome = TrainingResult(path, state.step, state.best_step, before, score(last, metadata, held_out), kept)
        record = dataclasses.replace(tuned, metrics={k: round(v, 4) for k, v in kept.metrics().items() if k != "score"})
        if calibrate:
            record = calibrate_sigma(best, record, held_out)
        save_checkpoint(best, outcome.noted_in(record), path, half=True)
    out.finish(outcome)
    for warning in outcome.warnings():
        logger.warning("%s", warning)
    return outcome


def _pictures(data: Data, held_out: Sequence[View]) -> list[View]:
    """Up to four views for TensorBoard, those with depth first."""
    views = list(held_out[:: max(len(held_out) // 4, 1)])
    views += [f.views[len(f.views) // 2] for f in data.labelled]
    for sequence in data.posed:
        v = sequence.views[len(sequence.views) // 2]
        views.append(View.without_depth(v.image, v.K))
    return views[:4]
