"""Teach given weights more places: ``python -m edgeslam_torch.train.recipes.places --data DIR --out DIR``.

1. Go on from given weights with rendered corridors, halls, sites and views from near, beside recordings.
2. The mean of the weights before and after, which often does better on places of neither than both ends do (Wortsman
   et al., CVPR 2022).

``near`` was made so from the default weights; ``--leave-out`` keeps a recording for judging.
"""

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.recipe import FINAL, train
from edgeslam_torch.train.recipes.default_weights import Progress, Scores
from edgeslam_torch.train.recipes.rendered_views import render_files
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.views.augment import AugmentConfig
from edgeslam_torch.train.views.datasets import load_depth_folder
from edgeslam_torch.train.views.rendered import stored_views

logger = logging.getLogger(__name__)

PLACES = "places"
SHARES = {"tum_fr1_rpy_depth": 0.25, "icl_livingroom1": 0.1, "icsl_corridor": 0.12, "hololens_a": 0.15, PLACES: 0.5}
"""Parts of the batch, relative to those of all that are taught."""
METRIC = 0.2
"""Weight of the places' metres: corridors have true widths, and real ones were estimated half as long as they are."""
NUMBER_OF_PLACES = 300
MEAN_SHARE = 0.5
"""Of the weights after, in the mean."""
AUGMENT = AugmentConfig(zoom=(0.85, 1.6), aspect=0.06, roll_rad=0.25, gamma=(0.7, 1.4), contrast=0.35, brightness=0.3)
WEIGHTS = SupervisedWeights(slope=0.1)
CONFIG = TrainConfig(
    steps=3600,
    lr=1e-3,
    encoder_lr=1.5e-4,
    lr_end=0.03,
    warmup_steps=20,
    ema_decay=0.996,
    seed=5,
    validate_every=500,
    checkpoint_every=100,
)


def teach_places(
    data: Path, out: Path, start: Path | None, config: TrainConfig, shares: dict[str, float], watch: Sequence[str] = ()
) -> Path:
    """Train; resumes where it was killed.

    Args:
        data: Folder with the recordings.
        out: Folder for everything.
        start: Weights to begin with; the shipped ones by default.
        config: Of the recipe.
        shares: Parts of the batch of recordings under ``data`` and of `PLACES`, relative to each other.
        watch: Recordings under ``data`` drawn into the curve, never trained on.

    Returns:
        The mean of the weights before and after.
    """
    out.mkdir(parents=True, exist_ok=True)
    render_files(out / PLACES, NUMBER_OF_PLACES, seed=16 + config.seed)
    first, *others = sorted((out / PLACES).glob("*.npz"))
    network, metadata = load_checkpoint(start)
    names = tuple(dict.fromkeys((*metadata.data, *shares)))
    metadata = dataclasses.replace(metadata, data=names, metrics={}, sigma_scale=1.0, sigma_floor=0.0)
    sources = [
        Source(name, [view for file in others for view in stored_views(file)], share, METRIC)
        if name == PLACES
        else Source(name, load_depth_folder(data / name, width=320).views, share)
        for name, share in shares.items()
    ]
    watched = {name: load_depth_folder(data / name, 480, stride=12).views for name in watch}
    validate = Scores(metadata, {PLACES: stored_views(first), **watched})
    train(network, metadata, [Supervised(sources, metadata, AUGMENT, WEIGHTS)], config, out, validate, [Progress()])
    before, after = load_checkpoint(start)[0], load_checkpoint(out / FINAL)[0]
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
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, help="to begin with (default: the shipped ones)")
    parser.add_argument("--leave-out", nargs="*", default=[], choices=[*SHARES], help="not to be taught")
    parser.add_argument("--steps", type=int, default=CONFIG.steps)
    parser.add_argument("--seed", type=int, default=CONFIG.seed, help="of places and steps")
    parser.add_argument("--device", default="auto", choices=DEVICES)
    parser.add_argument("--watch", nargs="*", default=[], help="recordings drawn into the curve, never trained on")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    config = dataclasses.replace(CONFIG, steps=args.steps, seed=args.seed, device=args.device, amp=None)
    shares = {name: share for name, share in SHARES.items() if name not in args.leave_out}
    logger.info("weights: %s", teach_places(args.data, args.out, args.weights, config, shares, args.watch))


if __name__ == "__main__":
    main()
