"""What training commands have in common: folders of images, SLAM on those without labels, an end by a signal."""

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.help.options import EXIT_INTERRUPTED

if TYPE_CHECKING:
    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.models.trainable import DepthModule
    from edgeslam_torch.train.folder import OutFolder, TrainingResult
    from edgeslam_torch.train.hooks import Hooks
    from edgeslam_torch.train.recipes.finetune import FromRuns
    from edgeslam_torch.train.state import TrainConfig
    from edgeslam_torch.train.views.datasets import DepthFolder
    from edgeslam_torch.train.views.posed import PosedSequence

logger = logging.getLogger(__name__)

MAX_THREADS = 256
"""Tens of thousands crash OpenMP."""


def add_shared_arguments(parser: argparse.ArgumentParser, steps: int, batch: int) -> None:
    """Declare the options of every training command."""
    parser.add_argument(
        "data",
        nargs="+",
        type=Path,
        help="recordings (TUM, 7-Scenes, EuRoC, flights, videos), folders of 'edgeslam run' or 'batch', tar shards",
    )
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for weights, curve and checkpoints")
    again = parser.add_mutually_exclusive_group()
    again.add_argument(
        "--resume",
        action="store_true",
        help="resume in --out, also at another --lr; an error if there is nothing to resume (without this option: "
        "resume if data, weights and settings are the same; more --steps are allowed)",
    )
    again.add_argument("--overwrite", action="store_true", help="replace an older training in --out")
    parser.add_argument("--max-frames", type=int, help="use the first frames of each recording only")
    parser.add_argument(
        "--validate",
        type=Path,
        nargs="*",
        default=[],
        help="recordings with depth to validate on (default: every tenth labelled image, not learnt from then)",
    )
    parser.add_argument("--steps", type=int, default=steps, help=f"default: {steps}; more overfits a single run")
    parser.add_argument("--batch", type=int, default=batch, help="images (or pairs) per step over all processes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--patience", type=int, default=0, help="stop after this many validations without progress")
    parser.add_argument(
        "--accumulate", type=int, default=1, help="learn each batch in this many parts, which takes less memory"
    )
    parser.add_argument(
        "--device",
        default="auto",
        help="auto, cpu, cuda or mps (default: auto, CUDA, then Apple's GPU, then processor)",
    )
    parser.add_argument(
        "--amp",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="half precision: bfloat16, on GPUs without it float16 (default: on CUDA alone)",
    )
    parser.add_argument(
        "--workers", type=int, default=0, help="processes that draw batches ahead, one thread each (default: 0)"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of each process")
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="FOLDER",
        help="keep the teacher's depth here for other trainings on the same runs (default: in --out, for this one)",
    )
    parser.add_argument("--camera", help="calibration for recordings without one")
    parser.add_argument(
        "--hook",
        action="append",
        default=[],
        metavar="MODULE:NAME",
        help="a training hook of your own, FILE.py:NAME too: losses, loggers, early stops; may be given more than once",
    )


def check_shared(args: argparse.Namespace) -> None:
    """Refuse numbers that make no sense.

    Raises:
        ConfigError: With the option's name.
    """
    if not 1 <= args.threads <= MAX_THREADS:
        raise ConfigError(f"--threads must be 1 to {MAX_THREADS}, got {args.threads}")
    if args.max_frames is not None and args.max_frames < 1:
        raise ConfigError(f"--max-frames must be at least 1, got {args.max_frames}")
    from edgeslam_torch.models.device import find_device

    find_device(args.device)


def train_config(args: argparse.Namespace, lr: float, frozen_stages: int, freeze_norm: bool) -> "TrainConfig":
    """Settings of a training that goes on from weights: eight validations, the encoder at a fifth of the rate.

    Args:
        args: The shared ones.
        lr: Peak learning rate of the decoder.
        frozen_stages: Of the encoder.
        freeze_norm: Whether batch norms keep their statistics.

    Raises:
        ConfigError: With the option that makes no sense.
    """
    from edgeslam_torch.train.state import TrainConfig

    every = max(args.steps // 8, 1)
    try:
        return TrainConfig(
            steps=args.steps,
            batch=args.batch,
            seed=args.seed,
            lr=lr,
            encoder_lr=lr / 5,
            frozen_stages=frozen_stages,
            freeze_norm=freeze_norm,
            warmup_steps=max(min(20, args.steps // 4), 0),
            ema_decay=0.99,
            validate_every=every,
            checkpoint_every=every,
            patience=args.patience,
            amp=args.amp,
            device=args.device,
            workers=args.workers,
            accumulate=args.accumulate,
        )
    except ValueError as error:
        raise ConfigError(f"--{error}") from error


def say(text: str) -> None:
    """One line, in the first process."""
    from edgeslam_torch.train.processes.distributed import rank

    if rank() == 0:
        print(text, flush=True)


def check_folder(
    args: argparse.Namespace,
    out: "OutFolder",
    start: "tuple[DepthModule, Metadata]",
    sets: Sequence[tuple[str, str]],
    config: "TrainConfig",
    reading: Mapping[str, object],
    hooks: "Sequence[Hooks]",
    from_runs: "FromRuns | None" = None,
) -> None:
    """Check whether training may begin or resume in ``out``, before anything is read.

    Args:
        args: The shared ones.
        out: Folder of the training.
        start: Network and metadata to begin with.
        sets: Name and kind of every data set.
        config: Of the recipe.
        reading: How the data is read.
        hooks: The user's.
        from_runs: What is learnt from images without labels.

    Raises:
        ConfigError, OutputError: If it holds another training, or something else.
    """
    from edgeslam_torch.train.folder import inputs
    from edgeslam_torch.train.processes.distributed import by_first
    from edgeslam_torch.train.recipes.finetune import FromRuns, settings_of

    validation = [os.path.basename(os.path.abspath(path)) for path in args.validate]
    settings = settings_of(config, from_runs or FromRuns.TEACHER, reading, hooks)
    expected = inputs(start, sets, validation, settings)
    by_first(lambda: out.check(expected))


def in_folder(args: argparse.Namespace, work: "Callable[[OutFolder], TrainingResult]") -> int:
    """Train in ``--out``, alone or as one of ``torchrun``'s processes, and print the outcome; the exit code."""
    import torch

    from edgeslam_torch.train.folder import Existing, out_folder
    from edgeslam_torch.train.processes.distributed import process_group

    torch.set_num_threads(args.threads)
    existing = Existing.RESUME if args.resume else Existing.OVERWRITE if args.overwrite else Existing.SAME
    with _signals_interrupt(), process_group() as rank:
        if rank:  # common warnings are printed once
            logging.getLogger("edgeslam_torch").setLevel(logging.ERROR)
        with out_folder(args.out, existing) as out:
            try:
                outcome = work(out)
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
class Item:
    """One training folder."""

    path: Path
    kind: str
    """``depth``, ``run``, or ``recording``, on which SLAM is run first."""
    name: str
    """Of the data set; of the run's folder for a recording."""


def items_of(args: argparse.Namespace, ignore_depth: bool) -> list[Item]:
    """Training folders of the arguments, by kind.

    Args:
        args: With ``data``, ``validate`` and ``out``.
        ignore_depth: Whether depth maps of recordings are no labels.

    Raises:
        SourceError: If a folder is missing, or has no depth to validate on.
        ConfigError: If a folder is used twice.
    """
    from edgeslam_torch.train.views.datasets import has_depth
    from edgeslam_torch.train.views.posed import is_run_folder
    from edgeslam_torch.train.views.shards import is_sharded

    items: list[Item] = []
    for path in _without_batches(args.data):
        if not path.exists():
            raise SourceError(f"{path}: no such recording or folder")
        if path.is_dir() and args.out.is_dir() and path.samefile(args.out):
            raise ConfigError(f"{path}: is a training folder; give another --out")
        name = os.path.basename(os.path.abspath(path))
        is_run = is_run_folder(path)
        has_labels = not is_run and (is_sharded(path) or has_depth(path))
        if ignore_depth and has_labels and is_sharded(path):
            raise SourceError(f"{path}: shards are single images with depth, which SLAM cannot run on")
        kind = "run" if is_run else "depth" if has_labels and not ignore_depth else "recording"
        if kind == "recording":  # of two recordings with one name each gets a run of its own
            same = sum(item.kind == kind and item.path.name == path.name for item in items)
            name = f"{name}-{same + 1}" if same else name
        items.append(Item(path, kind, name))
    for path in args.validate:
        if not (path.exists() and is_sharded(path)) and not has_depth(path):
            raise SourceError(f"{path}: no recording with depth (rgb.txt, depth.txt and camera.yaml) to validate on")
        if any(item.kind == "depth" and item.path.samefile(path) for item in items):
            raise ConfigError(f"{path}: is used for training and cannot validate; omit --validate")
    return sorted(items, key=lambda item: item.kind != "depth")


def _without_batches(paths: Sequence[Path]) -> list[Path]:
    """Folders of 'edgeslam batch', or what a shell's ``DIR/*`` makes of one, replaced by the runs in them."""
    from edgeslam_torch.fleet.folder import finished_flights, is_beside_flights

    found: list[Path] = []
    for path in paths:
        if is_beside_flights(path):
            continue
        runs = finished_flights(path)
        if runs == []:
            raise SourceError(f"{path}: no flight of this batch finished")
        found += [path] if runs is None else runs
    return found


def posed_run(
    item: Item, out: "OutFolder", camera: str | None, max_frames: int | None, weights: Path | None = None
) -> "PosedSequence":
    """Images, poses and map points of a run, or of a recording that SLAM is run on first, in ``out``."""
    from edgeslam_torch.train.processes.distributed import by_first
    from edgeslam_torch.train.views.posed import load_run
    from edgeslam_torch.train.views.slam_runs import ensure_run

    folder = item.path
    if item.kind == "recording":
        folder = subfolder(out.path, "slam") / item.name
        by_first(lambda: ensure_run(item.path, folder, weights, camera, max_frames, out.path))
    return load_run(folder, max_frames=max_frames)


def validation_folders(paths: Sequence[Path]) -> "list[DepthFolder]":
    """Images with depth to validate on."""
    return [labelled_folder(path, width=640) for path in paths]


def labelled_folder(path: Path, width: int = 400, max_frames: int | None = None) -> "DepthFolder":
    """Images with depth of a recording, or of tar shards."""
    from edgeslam_torch.train.views.datasets import load_depth_folder
    from edgeslam_torch.train.views.shards import is_sharded, load_shards

    if is_sharded(path):
        return load_shards(path, width, max_frames)
    return load_depth_folder(path, width, max_frames=max_frames)


def _left(out: "OutFolder") -> str:
    """Message after an interrupt."""
    if step := out.step:
        return f"{out.path} holds step {step}, and the same command resumes from there"
    return "no step was saved"
