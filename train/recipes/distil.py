"""Distil a larger depth network into FastDepth on recordings without labels.

1. Each recording has poses and a map by the SLAM (`posed`).
2. The teacher's depth is brought to that map view by view, by scale (or scale and shift, when it is relative) and
   smoothly near measured pixels; where the plane sweep measures depth, that counts instead (`label`).
3. The student learns from that as from any images with depth (`finetune`), and its uncertainty is calibrated.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from torch import nn

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.frontend.depth_check import usable
from edgeslam_torch.frontend.depth_network import DepthNetwork
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.depth_prior import fit_to_anchors
from edgeslam_torch.map.relative_depth import fit_inverse
from edgeslam_torch.models.checkpoint import build_network, file_hash, load_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.layout import Variant
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.folder import OutFolder, TrainingResult, content
from edgeslam_torch.train.hooks import Hooks
from edgeslam_torch.train.processes.distributed import rank, world
from edgeslam_torch.train.recipes.finetune import Data, finetune
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.teachers.teach import at_points, kept_depth, log_metres, teach
from edgeslam_torch.train.validate import contradiction
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.posed import PosedSequence, PosedView
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)


def distil(
    student: DepthModule,
    metadata: Metadata,
    teacher: DepthNetwork,
    runs: Iterable[PosedSequence],
    config: TrainConfig,
    out: OutFolder,
    validation: Sequence[DepthFolder] = (),
    reading: Mapping[str, object] = MappingProxyType({}),
    hooks: Sequence[Hooks] = (),
    cache: Path | None = None,
    say: Callable[[str], None] = logger.info,
) -> TrainingResult:
    """Train ``student`` on the teacher's depth of ``runs``; resumes a training in ``out`` with the same inputs.

    Metres are the teacher's, or the run's where it has none. The other arguments are those of `finetune`; ``say`` is
    called with a summary of the data, in the first process.

    Raises:
        ConfigError: If neither the teacher nor a run gives metres; and as `finetune`.
        SourceError: As `label` and `finetune`.
    """
    root, sha256 = cache or subfolder(out.path, "labels"), file_hash(teacher.weights)
    data = Data(validation=list(validation))
    for run in runs:
        if not (teacher.is_metric or run.metric):
            raise ConfigError(f"{run.name}: neither the teacher nor the run gives metres; add telemetry to it")
        log_scale = log_metres(partial(usable_depth, teacher), run) if teacher.is_metric else 0.0
        folder = kept_depth(root, run.name, content(run), sha256, log_scale)
        data.labelled.append(label(teacher, run, log_scale, folder))
    for line in data.describe() if rank() == 0 else ():
        say(line)
    return finetune(student, metadata, data, config, out, reading=reading, hooks=hooks, calibrate=True)


def new_student(variant: Variant) -> tuple[FastDepth, Metadata]:
    """A network to begin with: the shipped weights in layers of the same shape, new ones elsewhere.

    The first two variants share the encoder; of the pruned one, whose layers are narrower, next to everything is new.
    """
    shipped, metadata = load_checkpoint(None)
    if metadata.variant == variant:
        return shipped, metadata
    metadata = replace(metadata, variant=variant.value, metrics={}, notes="")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # the same at every call, so that a training can be resumed
        student = build_network(metadata)
    new, old = ([*network.encoder(), *network.decoder_layers()] for network in (student, shipped))
    kept = [_copied(a, b) for a, b in zip(new, old, strict=True)]
    logger.info("%s: %d of %d layers begin with the shipped weights", variant, sum(kept), len(kept))
    return student.eval(), metadata


def _copied(new: nn.Module, old: nn.Module) -> bool:
    """Give a layer the other's parameters, if all have the same shapes."""
    theirs = old.state_dict()
    if {k: v.shape for k, v in new.state_dict().items()} != {k: v.shape for k, v in theirs.items()}:
        return False
    new.load_state_dict(theirs)
    return True


def label(teacher: DepthNetwork, sequence: PosedSequence, log_scale: float, kept: Path) -> DepthFolder:
    """Dense depth [m] of a run's views by a teacher: measured where the plane sweep is confirmed, else the teacher's.

    ``log_scale`` is the log of metres per map unit; ``kept`` the folder from `kept_depth`.

    Raises:
        SourceError: If the teacher agrees with no view of the map.
        OSError: If a file cannot be written.
    """
    without: list[str] = []

    def predict(view: PosedView) -> FloatArray:
        depth = brought_to_map(teacher, view, log_scale)
        if depth is None:
            without.append(view.name)
            return np.full(view.image.shape[:2], np.nan, np.float32)
        return depth

    taught = teach(predict, sequence, log_scale, kept)
    views = [t.view for t in taught if (t.view.depth_m > 0).any()]
    if not views or (len(without) == len(taught) and world() == 1):
        raise SourceError(f"{sequence.name}: {teacher.weights.name} agrees with the map in none of its views")
    if without:
        logger.warning(
            "%s: %d images without the teacher's depth: it disagrees with the map", sequence.name, len(without)
        )
    folder = DepthFolder(sequence.name, views, tuple(without))
    if said := contradiction(*load_checkpoint(None), folder):
        logger.warning(said)
    return folder


def brought_to_map(teacher: DepthNetwork, view: PosedView, log_scale: float) -> FloatArray | None:
    """The teacher's depth [m] of a view ``(H, W)``, scaled to the map's points in it (by scale and shift of inverse
    depth, when it is relative); NaN where the teacher gives none. None if it does not agree with them."""
    depth = usable_depth(teacher, view)
    seen, metres = at_points(depth, view), view.z.astype(np.float64) * np.exp(log_scale)
    if not teacher.is_metric:
        line = fit_inverse(seen, metres)
        return None if line is None else np.asarray(line.depth(depth), np.float32)
    scale = fit_to_anchors(seen, metres)
    return None if scale is None else np.asarray(depth * np.exp(scale.log_ratio), np.float32)


def usable_depth(teacher: DepthNetwork, view: PosedView) -> FloatArray:
    """The teacher's depth ``(H, W)``, relative or [m]; NaN where it is not usable."""
    height, width = view.image.shape[:2]
    K = view.K
    found = teacher(view.image, Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return np.where(usable(found), found.depth_m, np.float32(np.nan))
