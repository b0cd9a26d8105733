"""``edgeslam finetune``: adapt the depth network to your camera and rooms."""

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from edgeslam_torch.models.fastdepth import FastDepth
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.train.finetuning import Data
    from edgeslam_torch.train.folder import OutFolder
    from edgeslam_torch.train.outcome import Outcome
    from edgeslam_torch.train.recipe import Hooks, TrainConfig

HELP = "adapt the depth network to recordings: labelled, unlabelled or output folders of 'edgeslam run'"

EXIT_INTERRUPTED = 130
MAX_THREADS = 256
"""Tens of thousands crash OpenMP."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "data",
        nargs="+",
        type=Path,
        help="recordings (TUM, 7-Scenes, EuRoC, flights, videos) or output folders of 'edgeslam run', in any mix",
    )
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for weights, curve and checkpoints")
    again = parser.add_mutually_exclusive_group()
    again.add_argument(
        "--resume",
        action="store_true",
        help="resume in --out, also at another --lr; an error if there is nothing to resume (without this option: "
        "resume if data, weights and settings are the same; more --steps are allowed)",
    )
    again.add_argument("--overwrite", action="store_true", help="replace an older fine-tuning in --out")
    parser.add_argument("--weights", type=Path, help="weights to start from (default: the shipped ones)")
    parser.add_argument("--ignore-depth", action="store_true", help="ignore depth maps of recordings")
    parser.add_argument("--max-frames", type=int, help="use the first frames of each recording only")
    parser.add_argument(
        "--validate",
        type=Path,
        nargs="*",
        default=[],
        help="recordings with depth to validate on (default: every tenth image with depth, measured by the teacher "
        "where there is no other, which is then not learnt from)",
    )
    parser.add_argument("--steps", type=int, default=100, help="default: 100; more overfits a single run")
    parser.add_argument("--batch", type=int, default=6, help="images (or pairs) per step over all processes")
    parser.add_argument("--lr", type=float, default=3e-4, help="learning rate of the decoder; the encoder's is a fifth")
    parser.add_argument(
        "--from-runs",
        choices=("teacher", "pairs", "both"),
        default="teacher",
        help="supervision for images without depth: depth measured with the run's poses (default), losses on pairs of "
        "images, or both (four times slower)",
    )
    parser.add_argument("--freeze-encoder", action="store_true", help="train the decoder alone (twice as fast)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--patience", type=int, default=0, help="stop after this many validations without progress")
    parser.add_argument("--amp", action="store_true", help="bfloat16 arithmetic where the processor has it")
    parser.add_argument("--threads", type=int, default=1, help="threads of each process")
    parser.add_argument("--camera", help="calibration for recordings without one")
    parser.add_argument(
        "--hook",
        action="append",
        default=[],
        metavar="MODULE:NAME",
        help="a training hook of your own, FILE.py:NAME too: losses, loggers, early stops (docs/training-your-own.md); "
        "may be given more than once",
    )


def main(args: argparse.Namespace) -> int:
    """Prepare the data, train, and print the results."""
    if not 1 <= args.threads <= MAX_THREADS:
        raise ConfigError(f"--threads must be 1 to {MAX_THREADS}, got {args.threads}")
    if args.max_frames is not None and args.max_frames < 1:
        raise ConfigError(f"--max-frames must be at least 1, got {args.max_frames}")
    items = _items(args)

    import torch

    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.train.folder import Existing, out_folder
    from edgeslam_torch.train.hook_names import named_hooks
    from edgeslam_torch.train.processes.distributed import process_group

    torch.set_num_threads(args.threads)
    config = _config(args)
    hooks = named_hooks(args.hook)
    network, metadata = load_checkpoint(args.weights)
    existing = Existing.RESUME if args.resume else Existing.OVERWRITE if args.overwrite else Existing.SAME
    with _signals_interrupt(), process_group() as rank:
        if rank:  # common warnings are printed once
            logging.getLogger("edgeslam_torch").setLevel(logging.ERROR)
        with out_folder(args.out, existing) as out:
            try:
                outcome = _finetune(args, items, network, metadata, config, hooks, out)
            except KeyboardInterrupt:
                if rank == 0:
                    sys.stderr.write(f"edgeslam: interrupted; {_left(out)}\n")
                return EXIT_INTERRUPTED
    if rank == 0:
        print(outcome.describe())
    return 0


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """``timeout``, ``torchrun`` and a closed terminal end training like Ctrl-C: after a step that is saved."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    in_main = threading.current_thread() is threading.main_thread()
    # Ignored signals stay ignored (nohup).
    taken = [n for n in numbers if in_main and signal.getsignal(n) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


@dataclass(frozen=True, slots=True)
class _Item:
    """One training folder."""

    path: Path
    kind: str
    """``depth``, ``run``, or ``recording``, on which SLAM is run first."""
    name: str
    """Of the data set; of the run's folder for a recording."""


def _items(args: argparse.Namespace) -> list[_Item]:
    """Training folders of the arguments, by kind."""
    from edgeslam_torch.train.views.datasets import has_depth
    from edgeslam_torch.train.views.posed import is_run_folder

    items: list[_Item] = []
    for path in args.data:
        if not path.exists():
            raise SourceError(f"{path}: no such recording or folder")
        if path.is_dir() and args.out.is_dir() and path.samefile(args.out):
            raise ConfigError(f"{path}: is a training folder; give another --out")
        name = os.path.basename(os.path.abspath(path))
        kind = "run" if is_run_folder(path) else "depth" if has_depth(path) and not args.ignore_depth else "recording"
        if kind == "recording":  # of two recordings with one name each gets a run of its own
            same = sum(item.kind == kind and item.path.name == path.name for item in items)
            name = f"{name}-{same + 1}" if same else name
        items.append(_Item(path, kind, name))
    for path in args.validate:
        if not has_depth(path):
            raise SourceError(f"{path}: no recording with depth (rgb.txt, depth.txt and camera.yaml) to validate on")
        if any(item.kind == "depth" and item.path.samefile(path) for item in items):
            raise ConfigError(f"{path}: is used for training and cannot validate; omit --validate")
    return sorted(items, key=lambda item: item.kind != "depth")


def _config(args: argparse.Namespace) -> "TrainConfig":
    from edgeslam_torch.train.recipe import TrainConfig

    every = max(args.steps // 8, 1)
    try:
        return TrainConfig(
            steps=args.steps,
            batch=args.batch,
            seed=args.seed,
            lr=args.lr,
            encoder_lr=args.lr / 5,
            frozen_stages=14 if args.freeze_encoder else 4,
            freeze_norm=True,
            warmup_steps=max(min(20, args.steps // 4), 0),
            ema_decay=0.99,
            validate_every=every,
            checkpoint_every=every,
            patience=args.patience,
            amp=args.amp,
        )
    except ValueError as error:
        raise ConfigError(f"--{error}") from error


def _finetune(
    args: argparse.Namespace,
    items: list[_Item],
    network: "FastDepth",
    metadata: "Metadata",
    config: "TrainConfig",
    hooks: "list[Hooks]",
    out: "OutFolder",
) -> "Outcome":
    from edgeslam_torch.train.finetuning import FromRuns, finetune, settings_of
    from edgeslam_torch.train.given import DataSet, Given, weights_name
    from edgeslam_torch.train.processes.distributed import by_first, rank

    from_runs = FromRuns(args.from_runs)
    reading = {name: getattr(args, name) for name in ("ignore_depth", "max_frames", "camera")}
    expected = Given(
        weights_name(network, metadata),
        tuple(DataSet(item.name, "depth" if item.kind == "depth" else "run") for item in items),
        tuple(DataSet(os.path.basename(os.path.abspath(path)), "depth") for path in args.validate),
        settings_of(config, from_runs, reading, hooks),
    )
    by_first(lambda: out.check(expected))  # fail before running SLAM
    if args.weights is not None and out.holds(args.weights):
        raise ConfigError(f"{args.weights}: would be overwritten by its own fine-tuning; give another --out")
    data = _data(args, items, out)
    if rank() == 0:
        for line in data.describe():
            print(line, flush=True)
        if not args.overwrite and 0 < (step := out.step) < args.steps:
            print(f"{out.path}: goes on after step {step}", flush=True)
    return finetune(network, metadata, data, config, out, from_runs, reading, hooks)


def _data(args: argparse.Namespace, items: list[_Item], out: "OutFolder") -> "Data":
    """Read the folders; SLAM is run on recordings without labels first."""
    from edgeslam_torch.train.finetuning import Data
    from edgeslam_torch.train.processes.distributed import by_first
    from edgeslam_torch.train.views.datasets import load_depth_folder
    from edgeslam_torch.train.views.posed import load_run
    from edgeslam_torch.train.views.slam_runs import ensure_run

    data = Data()
    for item in items:
        if item.kind == "depth":
            data.labelled.append(load_depth_folder(item.path, max_frames=args.max_frames))
            continue
        folder = item.path
        if item.kind == "recording":
            folder = out.path / "slam" / item.name
            by_first(lambda: ensure_run(item.path, folder, args.weights, args.camera, args.max_frames, out.path))  # noqa: B023
        data.posed.append(load_run(folder, max_frames=args.max_frames))
    for path in args.validate:
        data.validation.append(load_depth_folder(path, width=640))
    return data


def _left(out: "OutFolder") -> str:
    """Message after an interrupt."""
    if step := out.step:
        return f"{out.path} holds step {step}, and the same command goes on from there"
    return "no step was saved"
