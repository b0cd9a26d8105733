"""The shipped weights: ``python -m edgeslam_torch.train.recipes.weights default|near --data DIR --out DIR``.

``default``: 1. encoder from ImageNet; recordings and rendered rooms mixed, at a constant rate; 2. fewer rendered rooms
and gentler augmentation, the rate falling to nothing; 3. uncertainty calibrated on views of rooms held out from both.

``near``: 1. go on from given weights with rendered corridors, halls, sites and views from near, beside recordings;
2. the mean of the weights before and after, which often does better on places of neither than both ends do (Wortsman
et al., CVPR 2022).

The evaluation sequences are not used, except to plot the curve (``--watch``); the last weights are kept, not the best
on the curve. ``--leave-out`` keeps a recording of ``near`` for judging.
"""

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.imagenet import load_imagenet_encoder
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.calibrate_sigma import calibrate_sigma
from edgeslam_torch.train.callbacks import ProgressBar
from edgeslam_torch.train.loop import FINAL, train
from edgeslam_torch.train.recipes.rendered_views import is_worth_learning, render_files, render_rooms, stored_views
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.validate import score
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder

logger = logging.getLogger(__name__)

IMAGENET = "mobilenet_v1_imagenet/mobilenet_v1_1.0_224_quant_embedding_extractor.tflite"
INPUT_SIZE = (160, 224)
"""Height and width [px]; a third faster than 192x256 and as accurate (model card)."""
RENDERED, PLACES = "rendered", "places"
ROOMS, VIEWS_PER_ROOM, NUMBER_OF_PLACES = 350, 6, 300
HELD_OUT_VIEWS = 150
"""Last rendered views, whole rooms, kept out of training for the calibration."""
MEAN_SHARE = 0.5
"""Of the weights after, in the mean."""
LICENCE = (
    "Apache-2.0; encoder initialised from google-coral's MobileNetV1 (Apache-2.0); trained on TUM RGB-D freiburg1_rpy "
    "(CC BY 4.0, Sturm et al. 2012), ICL-NUIM living room 1 (CC BY 3.0, Handa et al. 2014) and rooms rendered by "
    "this project"
)


@dataclass(frozen=True, slots=True)
class Phase:
    """One training."""

    shares: dict[str, float]
    """Parts of the batch by recording, or `RENDERED` or `PLACES`, relative to each other."""
    config: TrainConfig
    augment: AugmentConfig
    metric: float
    """Weight of the metres of what is rendered."""
    weights: SupervisedWeights = field(default_factory=SupervisedWeights)

    def run(
        self, network: DepthModule, metadata: Metadata, pools: dict[str, Sequence[View]], out: Path, validate: "Scores"
    ) -> DepthModule:
        """Train, unless that is done; resumes where it was killed. Returns the averaged weights."""
        if (out / FINAL).is_file():
            logger.info("%s is there already", out / FINAL)
        else:
            sources = [
                Source(name, pools[name], share, self.metric if name in (RENDERED, PLACES) else 1.0)
                for name, share in self.shares.items()
            ]
            signal = Supervised(sources, metadata, self.augment, self.weights)
            train(network, metadata, [signal], self.config, out, validate, [ProgressBar()])
        return load_checkpoint(out / FINAL)[0]


# Rendered rooms supervise shape only: their sizes are invented, and as metric labels they double the error in real
# rooms.
BROAD = Phase(
    {"tum_fr1_rpy_depth": 0.5, "icl_livingroom1": 0.15, RENDERED: 0.35},
    TrainConfig(steps=2200, lr=1e-3, encoder_lr=1.2e-4, lr_end=1.0, validate_every=550, checkpoint_every=100),
    AugmentConfig(
        zoom=(0.9, 1.4), aspect=0.05, roll_rad=0.12, tilt_rad=0.08, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
    ),
    metric=0.1,
)
SETTLE = Phase(
    {"tum_fr1_rpy_depth": 0.65, "icl_livingroom1": 0.15, RENDERED: 0.2},
    TrainConfig(
        steps=1000, lr=1e-3, encoder_lr=1.2e-4, seed=1, warmup_steps=20, validate_every=500, checkpoint_every=100
    ),
    AugmentConfig(
        zoom=(0.95, 1.25), aspect=0.04, roll_rad=0.1, tilt_rad=0.05, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
    ),
    metric=0.1,
)
# Corridors have true widths, and real ones were estimated half as long as they are.
NEAR = Phase(
    {"tum_fr1_rpy_depth": 0.25, "icl_livingroom1": 0.1, "icsl_corridor": 0.12, "hololens_a": 0.15, PLACES: 0.5},
    TrainConfig(
        steps=3600,
        lr=1e-3,
        encoder_lr=1.5e-4,
        lr_end=0.03,
        warmup_steps=20,
        ema_decay=0.996,
        seed=5,
        validate_every=500,
        checkpoint_every=100,
        amp=None,
    ),
    AugmentConfig(zoom=(0.85, 1.6), aspect=0.06, roll_rad=0.25, gamma=(0.7, 1.4), contrast=0.35, brightness=0.3),
    metric=0.2,
    weights=SupervisedWeights(slope=0.1),
)


class Scores:
    """Of a network on named sets; the first one decides."""

    def __init__(self, metadata: Metadata, sets: dict[str, Sequence[View]]) -> None:
        self.metadata, self.sets = metadata, sets

    def __call__(self, network: DepthModule) -> dict[str, float]:
        """As `train` takes it."""
        metrics: dict[str, float] = {}
        for name, views in self.sets.items():
            for key, value in dataclasses.asdict(score(network, self.metadata, views)).items():
                metrics[f"{name}/{key}"] = round(value, 4)
        metrics["score"] = metrics[f"{next(iter(self.sets))}/abs_rel_scaled"]
        logger.info("%s", " ".join(f"{k} {v:.4f}" for k, v in metrics.items()))
        return metrics


def make_default(data: Path, out: Path, phases: Sequence[Phase] = (BROAD, SETTLE), watch: Sequence[str] = ()) -> Path:
    """Run all phases; each resumes where it was killed.

    Args:
        data: Folder with the recordings and the ImageNet encoder.
        out: Folder for everything.
        phases: With the same sources.
        watch: Recordings under ``data`` drawn into the curve, never trained on.

    Returns:
        The finished weights file.
    """
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    height, width = INPUT_SIZE
    names = ("ImageNet (encoder)", *phases[0].shares)
    metadata = Metadata(input_height=height, input_width=width, data=names, licence=LICENCE)
    rooms = out / "rendered.npz"
    if not rooms.is_file():
        render_rooms(rooms, ROOMS, VIEWS_PER_ROOM)
    rng = np.random.default_rng(0)
    rendered = [view for view in stored_views(rooms) if is_worth_learning(view.depth_m, rng.random())]
    held_out = rendered[-HELD_OUT_VIEWS:]
    pools: dict[str, Sequence[View]] = {
        name: rendered[:-HELD_OUT_VIEWS] if name == RENDERED else load_depth_folder(data / name).views
        for name in phases[0].shares
    }
    watched = {name: load_depth_folder(data / name, 640, stride=6).views for name in watch}
    validate = Scores(metadata, {RENDERED: held_out, **watched})
    new = build_network(metadata)
    load_imagenet_encoder(new, data / IMAGENET)
    network: DepthModule = new
    for phase, name in zip(phases, ("broad", "settle"), strict=True):
        network = phase.run(network, metadata, pools, out / name, validate)
    save_checkpoint(network, calibrate_sigma(network, metadata, held_out), out / "default.safetensors", half=True)
    return out / "default.safetensors"


def make_near(data: Path, out: Path, start: Path | None, phase: Phase = NEAR, watch: Sequence[str] = ()) -> Path:
    """Train; resumes where it was killed. Returns the file with the mean of the weights before and after.

    Args:
        data: Folder with the recordings.
        out: Folder for everything.
        start: Weights to begin with; the shipped ones by default.
        phase: What is taught, and how.
        watch: Recordings under ``data`` drawn into the curve, never trained on.
    """
    out.mkdir(parents=True, exist_ok=True)
    render_files(out / PLACES, NUMBER_OF_PLACES, seed=16 + phase.config.seed)
    first, *others = sorted((out / PLACES).glob("*.npz"))
    network, metadata = load_checkpoint(start)
    data_names = tuple(dict.fromkeys((*metadata.data, *phase.shares)))
    metadata = replace(metadata, data=data_names, metrics={}, sigma_scale=1.0, sigma_floor=0.0)
    pools: dict[str, Sequence[View]] = {
        name: [view for file in others for view in stored_views(file)]
        if name == PLACES
        else load_depth_folder(data / name, width=320).views
        for name in phase.shares
    }
    watched = {name: load_depth_folder(data / name, 480, stride=12).views for name in watch}
    after = phase.run(network, metadata, pools, out, Scores(metadata, {PLACES: stored_views(first), **watched}))
    before = load_checkpoint(start)[0]
    before.load_state_dict(mean_of(before, after, MEAN_SHARE))
    save_checkpoint(before, metadata, out / "mean.safetensors", half=True)
    return out / "mean.safetensors"


def mean_of(first: DepthModule, second: DepthModule, share: float) -> dict[str, torch.Tensor]:
    """State of ``(1 - share) first + share second``; whole numbers are the first's.

    Raises:
        WeightsError: If they are not the same network.
    """
    one, other = first.state_dict(), second.state_dict()
    if {k: v.shape for k, v in one.items()} != {k: v.shape for k, v in other.items()}:
        raise WeightsError("only weights of one network have a mean: these differ in names or shapes")
    return {k: v.lerp(other[k], share) if v.is_floating_point() else v for k, v in one.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=("default", "near"))
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--watch", nargs="*", default=[], help="recordings drawn into the curve, never trained on")
    parser.add_argument("--steps", type=int, nargs="+", help="other lengths of the phases")
    parser.add_argument("--leave-out", nargs="*", default=[], help="sources not to be taught")
    parser.add_argument("--weights", type=Path, help="near: to begin with (default: the shipped ones)")
    parser.add_argument("--seed", type=int, default=NEAR.config.seed, help="near: of places and steps")
    parser.add_argument("--device", default="auto", choices=DEVICES, help="near: where it is computed")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    phases = [BROAD, SETTLE] if args.job == "default" else [NEAR]
    steps = args.steps or [phase.config.steps for phase in phases]
    own = {} if args.job == "default" else {"seed": args.seed, "device": args.device}
    phases = [
        replace(
            phase,
            shares={name: share for name, share in phase.shares.items() if name not in args.leave_out},
            config=replace(phase.config, steps=count, **own),
        )
        for phase, count in zip(phases, steps, strict=True)
    ]
    if args.job == "default":
        logger.info("weights: %s", make_default(args.data, args.out, phases, args.watch))
    else:
        logger.info("weights: %s", make_near(args.data, args.out, args.weights, phases[0], args.watch))


if __name__ == "__main__":
    main()
