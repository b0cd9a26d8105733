"""``edgeslam finetune``: adapt the depth network to your camera and rooms."""

import argparse
import logging
from typing import TYPE_CHECKING

from edgeslam_torch.commands.training._inputs import (
    Item,
    add_shared_arguments,
    check_folder,
    check_shared,
    in_folder,
    items_of,
    labelled_folder,
    posed_run,
    say,
    train_config,
    validation_folders,
)
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.models.record import weights_file

if TYPE_CHECKING:
    from edgeslam_torch.models.fastdepth import FastDepth
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.train.folder import OutFolder, TrainingResult
    from edgeslam_torch.train.hooks import Hooks
    from edgeslam_torch.train.recipes.finetune import Data
    from edgeslam_torch.train.state import TrainConfig

logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_shared_arguments(parser, steps=100, batch=6)
    parser.add_argument(
        "--depth",
        dest="weights",
        type=weights_file,
        metavar="FILE|NAME",
        help="weights to start from: a file, 'default' or 'near' (default: default)",
    )
    parser.add_argument("--weights", type=weights_file, default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    parser.add_argument("--ignore-depth", action="store_true", help="ignore depth maps of recordings")
    parser.add_argument("--lr", type=float, default=3e-4, help="learning rate of the decoder; the encoder's is a fifth")
    parser.add_argument(
        "--from-runs",
        choices=("teacher", "pairs", "both"),
        default="teacher",
        help="supervision for images without depth: depth measured with the run's poses (default), losses on pairs of "
        "images, or both (four times slower)",
    )
    parser.add_argument("--freeze-encoder", action="store_true", help="train the decoder alone (twice as fast)")


def main(args: argparse.Namespace) -> int:
    """Prepare the data, train, and print the results."""
    check_shared(args)
    items = items_of(args, args.ignore_depth)

    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.train.hooks import named_hooks

    config = train_config(args, args.lr, frozen_stages=14 if args.freeze_encoder else 4, freeze_norm=True)
    hooks = named_hooks(args.hook)
    network, metadata = load_checkpoint(args.weights)
    return in_folder(args, lambda out: _finetune(args, items, network, metadata, config, hooks, out))


def _finetune(
    args: argparse.Namespace,
    items: list[Item],
    network: "FastDepth",
    metadata: "Metadata",
    config: "TrainConfig",
    hooks: "list[Hooks]",
    out: "OutFolder",
) -> "TrainingResult":
    from edgeslam_torch.train.recipes.finetune import FromRuns, finetune
    from edgeslam_torch.train.validate import contradiction

    from_runs = FromRuns(args.from_runs)
    reading = {name: getattr(args, name) for name in ("ignore_depth", "max_frames", "camera")}
    sets = [(item.name, "depth" if item.kind == "depth" else "run") for item in items]
    check_folder(args, out, (network, metadata), sets, config, reading, hooks, from_runs)
    if args.weights is not None and out.holds(args.weights):
        raise ConfigError(f"{args.weights}: would be overwritten by its own fine-tuning; give another --out")
    data = _data(args, items, out)
    for line in data.describe():
        say(line)
    for folder in (*data.labelled, *data.validation):
        if said := contradiction(network, metadata, folder):
            logger.warning(said)
    if not args.overwrite and 0 < (step := out.step) < args.steps:
        say(f"{out.path}: resumes after step {step}")
    return finetune(network, metadata, data, config, out, from_runs, reading, hooks, args.cache)


def _data(args: argparse.Namespace, items: list[Item], out: "OutFolder") -> "Data":
    """Read the folders; SLAM is run on recordings without labels first."""
    from edgeslam_torch.train.recipes.finetune import Data
    from edgeslam_torch.train.views.posed import TooFewViews

    data = Data(validation=validation_folders(args.validate))
    useless: list[TooFewViews] = []
    for item in items:
        if item.kind == "depth":
            data.labelled.append(labelled_folder(item.path, max_frames=args.max_frames))
            continue
        try:
            data.posed.append(posed_run(item, out, args.camera, args.max_frames, args.weights))
        except TooFewViews as error:  # one of a fleet's flights; the others teach
            useless.append(error)
    if useless and not data.labelled and not data.posed:
        raise useless[0]
    for left_out in useless:
        logger.warning("left out: %s", left_out)
    return data
