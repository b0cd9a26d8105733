"""Teach given weights more places: ``python -m edgeslam_torch.train.recipes.weights --data DIR --out DIR``.

It goes on from the shipped weights with rendered corridors, halls, sites and views from near (`places`) beside
recordings; ``--leave-out`` keeps one of these for judging. `mean` then averages the weights of before and after.
"""

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.models.device import DEVICES, find_device
from edgeslam_torch.train.default_weights import Progress, validation_of
from edgeslam_torch.train.recipe import FINAL, TrainConfig, train
from edgeslam_torch.train.recipes.device_signal import POOL_SIZE, Arriving, Pool, SupervisedOnDevice
from edgeslam_torch.train.recipes.rendered_views import render_files
from edgeslam_torch.train.signals import SupervisedWeights
from edgeslam_torch.train.views.augment import AugmentConfig
from edgeslam_torch.train.views.batches import on_device
from edgeslam_torch.train.views.datasets import load_depth_folder

logger = logging.getLogger(__name__)

PLACES = "places"
SHARES = {"tum_fr1_rpy_depth": 0.25, "icl_livingroom1": 0.1, "icsl_corridor": 0.12, "hololens_a": 0.15, PLACES: 0.5}
"""Parts of the batch, relative to those of all that are taught."""
METRIC = 0.2
"""Weight of the places' metres: corridors have true widths, and real ones were estimated half as long as they are."""
NUMBER_OF_PLACES = 300
AUGMENT = AugmentConfig(zoom=(0.85, 1.6), aspect=0.06, roll_rad=0.25, gamma=(0.7, 1.4), contrast=0.35, brightness=0.3)
WEIGHTS = SupervisedWeights(slope=0.1)
ENCODER_SHARE = 0.15
CONFIG = TrainConfig(
    steps=3600,
    lr=1e-3,
    encoder_lr=ENCODER_SHARE * 1e-3,
    lr_end=0.03,
    warmup_steps=20,
    ema_decay=0.996,
    seed=5,
    validate_every=500,
    checkpoint_every=100,
)


def teach_places(
    data: Path,
    out: Path,
    start: Path | None,
    config: TrainConfig,
    shares: dict[str, float],
    watch: Sequence[str] = (),
    drawn: Path | None = None,
) -> Path:
    """Train; resumes where it was killed.

    Args:
        data: Folder with the recordings.
        out: Folder for everything.
        start: Weights to begin with; the shipped ones by default.
        config: Of the recipe.
        shares: Parts of the batch of recordings under ``data`` and of `PLACES`, relative to each other.
        watch: Recordings under ``data`` drawn into the curve, never trained on.
        drawn: Folder of `places` that may still grow; without one, places are drawn first.

    Returns:
        The weights after the last step.
    """
    out.mkdir(parents=True, exist_ok=True)
    if drawn is None:
        drawn = out / "places"
        render_files(drawn, NUMBER_OF_PLACES, seed=16 + config.seed)
    arriving = Arriving(drawn)
    held_out, places = arriving.wait(), arriving.wait()
    network, metadata = load_checkpoint(start)
    names = (*metadata.data, *(name for name in shares if name not in metadata.data))
    metadata = dataclasses.replace(metadata, data=names, sigma_scale=1.0, sigma_floor=0.0)
    device = find_device(config.device)
    pools = []
    for name, share in shares.items():
        views = places if name == PLACES else load_depth_folder(data / name, width=320).views
        on = on_device(views, POOL_SIZE, device)
        pools.append(Pool(name, on, share, METRIC, arriving) if name == PLACES else Pool(name, on, share))
    watched = {name: load_depth_folder(data / name, 480, stride=12).views for name in watch}
    validate = validation_of(metadata, {PLACES: held_out, **watched})
    signal = SupervisedOnDevice(pools, metadata, AUGMENT, WEIGHTS)
    train(network, metadata, [signal], config, out, validate, [Progress()])
    return out / FINAL


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, help="to begin with (default: the shipped ones)")
    parser.add_argument("--seed", type=int, default=CONFIG.seed, help="of places and steps")
    parser.add_argument("--leave-out", nargs="*", default=[], choices=[*SHARES], help="not to be taught")
    parser.add_argument("--places", type=Path, help="folder that `places` draws into (default: drawn first)")
    parser.add_argument("--lr", type=float, default=CONFIG.lr, help="of the decoder; the encoder has .15 of it")
    parser.add_argument("--steps", type=int, default=CONFIG.steps)
    parser.add_argument("--batch", type=int, default=CONFIG.batch)
    parser.add_argument("--ema", type=float, default=CONFIG.ema_decay, help="decay of the averaged weights")
    parser.add_argument("--validate-every", type=int, default=CONFIG.validate_every)
    parser.add_argument("--device", default="auto", choices=DEVICES)
    parser.add_argument("--watch", nargs="*", default=[], help="recordings drawn into the curve, never trained on")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    config = dataclasses.replace(
        CONFIG,
        steps=args.steps,
        batch=args.batch,
        seed=args.seed,
        lr=args.lr,
        encoder_lr=ENCODER_SHARE * args.lr,
        ema_decay=args.ema,
        validate_every=args.validate_every,
        checkpoint_every=args.validate_every,
        device=args.device,
        amp=None,
        channels_last=find_device(args.device).type == "cuda",
    )
    shares = {name: share for name, share in SHARES.items() if name not in args.leave_out}
    made = teach_places(args.data, args.out, args.weights, config, shares, args.watch, args.places)
    logger.info("weights: %s", made)


if __name__ == "__main__":
    main()
