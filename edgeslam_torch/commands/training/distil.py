"""``edgeslam distil``: distil a larger depth network into FastDepth."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.commands.training._inputs import (
    Item,
    add_shared_arguments,
    check_shared,
    in_folder,
    items_of,
    posed_run,
    teacher_cache,
    train_config,
    validation_folders,
)
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.plain import subfolder

if TYPE_CHECKING:
    from edgeslam_torch.frontend.depth_network import DepthNetwork
    from edgeslam_torch.models.fastdepth import FastDepth
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.train.finetuning import Data
    from edgeslam_torch.train.folder import OutFolder
    from edgeslam_torch.train.recipe import Hooks, TrainConfig
    from edgeslam_torch.train.result import TrainingResult

HELP = "distil a larger depth network into a drone-sized one, on recordings without labels"


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
    from edgeslam_torch.train.hook_names import named_hooks

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
    from edgeslam_torch.train.teachers.distil import new_student

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
    from edgeslam_torch.train.finetuning import FromRuns, finetune, settings_of
    from edgeslam_torch.train.inputs import DataSet, Inputs, weights_name
    from edgeslam_torch.train.processes.distributed import by_first, rank

    sha256 = file_hash(teacher.weights)
    reading = {"teacher": f"{teacher.weights.name} {sha256[:12]}", "max_frames": args.max_frames, "camera": args.camera}
    expected = Inputs(
        weights_name(student, metadata),
        tuple(DataSet(item.name, "depth") for item in items),
        tuple(DataSet(os.path.basename(os.path.abspath(path)), "depth") for path in args.validate),
        settings_of(config, FromRuns.TEACHER, reading, hooks),
    )
    by_first(lambda: out.check(expected))  # fail before running SLAM
    data = _labelled(args, items, teacher, sha256, out)
    if rank() == 0:
        for line in data.describe():
            print(line, flush=True)
    return finetune(student, metadata, data, config, out, reading=reading, hooks=hooks, calibrate=True)


def _labelled(
    args: argparse.Namespace, items: list[Item], teacher: "DepthNetwork", sha256: str, out: "OutFolder"
) -> "Data":
    """The recordings with the teacher's depth; metres are the teacher's, or the run's where it has none."""
    from edgeslam_torch.train.finetuning import Data
    from edgeslam_torch.train.inputs import posed_set
    from edgeslam_torch.train.processes.distributed import rank
    from edgeslam_torch.train.teachers.distil import label

    cache = teacher_cache(args)
    data = Data(validation=validation_folders(args.validate))
    for number, item in enumerate(items):
        run = posed_run(item, out, args.camera, args.max_frames)
        if not (teacher.is_metric or run.metric):
            raise ConfigError(f"{item.path}: neither the teacher nor the run gives metres; add telemetry to it")
        scale = None if teacher.is_metric else 0.0
        folder = subfolder(out.path, "labels") / f"{number}-{item.name}-{sha256[:12]}"
        if cache is not None:
            folder = cache.entry(item.name, str(posed_set(run).sha256), sha256, repr(scale))
        labels = label(teacher, run, scale, folder)
        data.labelled.append(labels.folder)
        if rank() == 0:
            print(labels.describe(), flush=True)
    return data
