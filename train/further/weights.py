"""Teach given weights more places: ``python -m edgeslam_torch.train.further.weights --data DIR --out DIR``.

It goes on from the shipped weights with rendered corridors, halls, sites and views from near (`places`) beside
recordings; ``--leave-out`` keeps one of these for judging. `mean` then averages the weights of before and after.
docs/experiments/depth-weights.md has the figures.
"""

import argparse
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.train.default_weights import HELD_OUT_VIEWS, Progress, validation_of
from edgeslam_torch.train.further.places import render_places
from edgeslam_torch.train.recipe import FINAL, TrainConfig, train
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder
from edgeslam_torch.train.views.rendered import load_rendered

logger = logging.getLogger(__name__)

PLACES = "places"
SHARES = {"tum_fr1_rpy_depth": 0.32, "icl_livingroom1": 0.1, "icsl_corridor": 0.13, "hololens_a": 0.13, PLACES: 0.45}
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
    drawn: Sequence[Path] = (),
) -> Path:
    """Train; resumes where it was killed.

    Args:
        data: Folder with the recordings.
        out: Folder for everything.
        start: Weights to begin with; the shipped ones by default.
        config: Of the recipe.
        shares: Parts of the batch of recordings under ``data`` and of `PLACES`, relative to each other.
        watch: Recordings under ``data`` drawn into the curve, never trained on.
        drawn: Files of `render_places` to learn from; without any, one is drawn.

    Returns:
        The weights after the last step.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not drawn:
        drawn = [out / "places.npz"]
        if not drawn[0].is_file():
            render_places(drawn[0], NUMBER_OF_PLACES, seed=16 + config.seed)
    views = [load_rendered(path) for path in drawn]
    held_out = [view for those in views for view in those[-HELD_OUT_VIEWS:]]
    places = [view for those in views for view in those[:-HELD_OUT_VIEWS]]
    pools: dict[str, Sequence[View]] = {
        name: places if name == PLACES else load_depth_folder(data / name, width=320).views for name in shares
    }
    network, metadata = load_checkpoint(start)
    names = (*metadata.data, *(name for name in shares if name not in metadata.data))
    metadata = dataclasses.replace(metadata, data=names, sigma_scale=1.0, sigma_floor=0.0)
    sources = [Source(name, pools[name], share, METRIC if name == PLACES else 1.0) for name, share in shares.items()]
    watched = {name: load_depth_folder(data / name, 480, stride=12).views for name in watch}
    validate = validation_of(metadata, {PLACES: held_out[:: 3 * len(views)], **watched})
    train(network, metadata, [Supervised(sources, metadata, AUGMENT, WEIGHTS)], config, out, validate, [Progress()])
    return out / FINAL


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, help="to begin with (default: the shipped ones)")
    parser.add_argument("--seed", type=int, default=CONFIG.seed, help="of places and steps")
    parser.add_argument("--leave-out", nargs="*", default=[], choices=[*SHARES], help="not to be taught")
    parser.add_argument(
        "--places", nargs="*", type=Path, default=[], help="files of earlier runs (default: drawn anew)"
    )
    parser.add_argument("--lr", type=float, default=CONFIG.lr, help="of the decoder; the encoder has .15 of it")
    parser.add_argument("--steps", type=int, default=CONFIG.steps)
    parser.add_argument("--watch", nargs="*", default=[], help="recordings drawn into the curve, never trained on")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    config = dataclasses.replace(
        CONFIG, steps=args.steps, seed=args.seed, lr=args.lr, encoder_lr=ENCODER_SHARE * args.lr
    )
    shares = {name: share for name, share in SHARES.items() if name not in args.leave_out}
    made = teach_places(args.data, args.out, args.weights, config, shares, args.watch, args.places)
    logger.info("weights: %s", made)


if __name__ == "__main__":
    main()
