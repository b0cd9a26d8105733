"""``edgeslam distil``: distil a larger depth network into FastDepth."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.commands.training._inputs import (
    Item,
    add_shared_arguments,
    check_folder,
    check_shared,
    in_folder,
    items_of,
    posed_run,
    say,
    train_config,
    validation_folders,
)
from edgeslam_torch.errors import ConfigError

if TYPE_CHECKING:
    from edgeslam_torch.frontend.depth_network import DepthNetwork
    from edgeslam_torch.models.fastdepth import FastDepth
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.train.folder import OutFolder, TrainingResult
    from edgeslam_torch.train.hooks import Hooks
    from edgeslam_torch.train.state import TrainConfig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--teacher", required=True, metavar="FILE|NAME", help="the larger network, as for 'edgeslam run --depth'"
    )
    parser.add_argument(
        "--depth",
        default="mobilenet-nnconv5dw-skipadd",
        metavar="VARIANT|FILE",
        help="weights to start from: a file, or a variant of FastDepth, which begins with the shipped weights where "
        "shapes are the same (default: the shipped ones)",
    )
    parser.add_argument("--student", dest="depth", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    add_shared_arguments(parser, steps=400, batch=8)
    parser.add_argument(
        "--lr",
        type=float,
        help="learning rate of the decoder (default: 3e-4, of a new variant 1e-3); the encoder's is a fifth",
    )


def main(args: argparse.Namespace) -> int:
    """Label the recordings, train, and print the results."""
    check_shared(args)
    items = items_of(args, ignore_depth=True)

    from edgeslam_torch.frontend.depth_network import open_depth, weights_path
    from edgeslam_torch.train.hooks import named_hooks

    teacher = open_depth(weights_path(args.teacher), threads=args.threads)
    student, metadata, is_new = _student(args.depth)
    config = _config(args, is_new)
    hooks = named_hooks(args.hook)
    return in_folder(args, lambda out: _distil(args, items, teacher, student, metadata, config, hooks, out))


def _student(name: str) -> "tuple[FastDepth, Metadata, bool]":
    """The network to begin with, its record, and whether parts of it are new."""
    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.models.layout import Variant
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.train.recipes.distil import new_student

    if name in [*Variant]:
        network, metadata = new_student(Variant(name))
        return network, metadata, name != Metadata().variant
    if not Path(name).suffix:
        raise ConfigError(f"--depth {name}: no weights file, and no variant; there are {', '.join(Variant)}")
    return *load_checkpoint(Path(name)), False


def _config(args: argparse.Namespace, is_new: bool) -> "TrainConfig":
    """A new variant learns everything, at a higher rate."""
    lr = args.lr if args.lr is not None else 1e-3 if is_new else 3e-4
    return train_config(args, lr, frozen_stages=0 if is_new else 4, freeze_norm=not is_new)


def _distil(
    args: argparse.Namespace,
    items: list[Item],
    teacher: "DepthNetwork",
    student: "FastDepth",
    metadata: "Metadata",
    config: "TrainConfig",
    hooks: "list[Hooks]",
    out: "OutFolder",
) -> "TrainingResult":
    from edgeslam_torch.models.checkpoint import file_hash
    from edgeslam_torch.train.recipes.distil import distil

    name = f"{teacher.weights.name} {file_hash(teacher.weights)[:12]}"
    reading = {"teacher": name, "max_frames": args.max_frames, "camera": args.camera}
    check_folder(args, out, (student, metadata), [(item.name, "depth") for item in items], config, reading, hooks)
    validation = validation_folders(args.validate)
    runs = (replace(posed_run(item, out, args.camera, args.max_frames), name=item.name) for item in items)
    return distil(student, metadata, teacher, runs, config, out, validation, reading, hooks, args.cache, say)
