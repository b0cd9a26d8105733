"""The shipped weights: ``python -m edgeslam_torch.train.recipes.weights default|near --data DIR --out DIR``.

``default``: 1. encoder from ImageNet; recordings and rendered rooms mixed, at a constant rate; 2. fewer rendered rooms
and gentler augmentation, the rate falling to nothing; 3. uncertainty calibrated on views of rooms held out from both.

``near``: 1. go on from given weights with rendered corridors, halls, sites and views from near, beside recordings;
2. the mean of the weights before and after, which often does better on places of neither than both ends do (Wortsman
et al., CVPR 2022).

No recording that figures are quoted of is used; the last weights are kept, not the best on the curve.
"""

import argparse
import logging
from collections.abc import Callable, Sequence
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
from edgeslam_torch.train.recipes.rendered_views import Drawn, place_views, render_files, room_views, stored_views
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.validate import score
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder

logger = logging.getLogger(__name__)

IMAGENET = "mobilenet_v1_imagenet/mobilenet_v1_1.0_224_quant_embedding_extractor.tflite"
INPUT_SIZE = (160, 224)
"""Height and width [px]; a third faster than 192x256 and as accurate (model card)."""
RENDERED = "rendered"
NUMBER_OF_ROOMS, NUMBER_OF_PLACES = 350, 300
HELD_OUT_VIEWS = 150
"""First rendered views, of whole places, kept out of training for the curve and the calibration."""
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
    """Parts of the batch by recording, or `RENDERED`, relative to each other."""
    config: TrainConfig
    augment: AugmentConfig
    metric: float
    """Weight of the metres of what is rendered."""
    weights: SupervisedWeights = field(default_factory=SupervisedWeights)

    def run(
        self,
        network: DepthModule,
        metadata: Metadata,
        pools: dict[str, Sequence[View]],
        out: Path,
        held_out: Sequence[View],
    ) -> DepthModule:
        """Train, unless that is done; resumes where it was killed. Returns the averaged weights.

        ``held_out`` draws the curve.
        """
        if (out / FINAL).is_file():
            logger.info("%s is there already", out / FINAL)
        else:
            sources = [
                Source(name, pools[name], share, self.metric if name == RENDERED else 1.0)
                for name, share in self.shares.items()
            ]
            signal = Supervised(sources, metadata, self.augment, self.weights)
            train(
                network,
                metadata,
                [signal],
                self.config,
                out,
                lambda averaged: score(averaged, metadata, held_out).metrics(),
                [ProgressBar()],
            )
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
    {"tum_fr1_rpy_depth": 0.25, "icl_livingroom1": 0.1, "icsl_corridor": 0.12, "hololens_a": 0.15, RENDERED: 0.5},
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


def make_default(data: Path, out: Path) -> Path:
    """Run both phases; each resumes where it was killed. Returns the finished weights file.

    Args:
        data: Folder with the recordings and the ImageNet encoder.
        out: Folder for everything.
    """
    torch.manual_seed(0)
    height, width = INPUT_SIZE
    names = ("ImageNet (encoder)", *BROAD.shares)
    metadata = Metadata(input_height=height, input_width=width, data=names, licence=LICENCE)
    rooms, held_out = _rendered(out / RENDERED, room_views, NUMBER_OF_ROOMS, seed=7)
    pools = _pools(data, BROAD, rooms, width=400)
    new = build_network(metadata)
    load_imagenet_encoder(new, data / IMAGENET)
    network: DepthModule = new
    for phase, name in ((BROAD, "broad"), (SETTLE, "settle")):
        network = phase.run(network, metadata, pools, out / name, held_out)
    save_checkpoint(network, calibrate_sigma(network, metadata, held_out), out / "default.safetensors", half=True)
    return out / "default.safetensors"


def make_near(data: Path, out: Path, start: Path | None, device: str = "auto") -> Path:
    """Train; resumes where it was killed. Returns the file with the mean of the weights before and after.

    Args:
        data: Folder with the recordings.
        out: Folder for everything.
        start: Weights to begin with; the shipped ones by default.
        device: Where it is computed.
    """
    places, held_out = _rendered(out / RENDERED, place_views, NUMBER_OF_PLACES, seed=21)
    network, metadata = load_checkpoint(start)
    data_names = tuple(dict.fromkeys((*metadata.data, *NEAR.shares)))
    metadata = replace(metadata, data=data_names, metrics={}, sigma_scale=1.0, sigma_floor=0.0)
    phase = replace(NEAR, config=replace(NEAR.config, device=device))
    after = phase.run(network, metadata, _pools(data, NEAR, places, width=320), out, held_out)
    before = load_checkpoint(start)[0]
    before.load_state_dict(mean_of(before, after, MEAN_SHARE))
    save_checkpoint(before, metadata, out / "mean.safetensors", half=True)
    return out / "mean.safetensors"


def _rendered(
    folder: Path, views: Callable[[np.random.Generator], Drawn], places: int, seed: int
) -> tuple[list[View], list[View]]:
    """Rendered views to learn from, and `HELD_OUT_VIEWS` or some more of the first places, held out."""
    taught: list[View] = []
    held_out: list[View] = []
    for file in render_files(folder, views, places, seed):
        (taught if len(held_out) >= HELD_OUT_VIEWS else held_out).extend(stored_views(file))
    return taught, held_out


def _pools(data: Path, phase: Phase, rendered: Sequence[View], width: int) -> dict[str, Sequence[View]]:
    """What a phase draws from, by name."""
    return {
        name: rendered if name == RENDERED else load_depth_folder(data / name, width).views for name in phase.shares
    }


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
    parser.add_argument("--weights", type=Path, help="near: to begin with (default: the shipped ones)")
    parser.add_argument("--device", default="auto", choices=DEVICES, help="near: where it is computed")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    if args.job == "default":
        logger.info("weights: %s", make_default(args.data, args.out))
    else:
        logger.info("weights: %s", make_near(args.data, args.out, args.weights, args.device))


if __name__ == "__main__":
    main()
