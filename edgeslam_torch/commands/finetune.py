"""``edgeslam finetune``: adapt the depth network to one's own camera and rooms."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from edgeslam_torch.train.finetune import Data

HELP = "adapt the depth network to recordings: labelled, unlabelled or output folders of 'edgeslam run'"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "data",
        nargs="+",
        type=Path,
        help="recordings (TUM, 7-Scenes, EuRoC, flights, videos) or output folders of 'edgeslam run', in any mix",
    )
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for weights, curve and checkpoints")
    parser.add_argument("--weights", type=Path, help="weights to start from (default: the shipped ones)")
    parser.add_argument("--ignore-depth", action="store_true", help="do not use depth maps that recordings hold")
    parser.add_argument("--max-frames", type=int, help="use the first frames of each recording only")
    parser.add_argument("--validate", type=Path, nargs="*", default=[], help="recordings with depth to validate on")
    parser.add_argument("--steps", type=int, default=100, help="default: 100; more learns a run by heart")
    parser.add_argument("--batch", type=int, default=6, help="images (or pairs) per step over all processes")
    parser.add_argument("--lr", type=float, default=3e-4, help="learning rate of the decoder; the encoder's is a fifth")
    parser.add_argument(
        "--from-runs",
        choices=("teacher", "pairs", "both"),
        default="teacher",
        help="what images without depth teach: depth measured with the run's poses (default), losses on pairs of "
        "images, or both (four times slower)",
    )
    parser.add_argument("--freeze-encoder", action="store_true", help="train the decoder alone (twice as fast)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--patience", type=int, default=0, help="stop after this many validations without progress")
    parser.add_argument("--amp", action="store_true", help="bfloat16 arithmetic where the processor has it")
    parser.add_argument("--threads", type=int, default=1, help="threads of each process")
    parser.add_argument("--camera", help="calibration for recordings that hold none")


def main(args: argparse.Namespace) -> int:
    """Prepare the data, train, print what came of it."""
    import torch

    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.train.distributed import process_group
    from edgeslam_torch.train.finetune import FromRuns, finetune
    from edgeslam_torch.train.recipe import TrainConfig

    if args.steps < 1 or args.batch < 1:
        raise ConfigError("--steps and --batch must be at least 1")
    torch.set_num_threads(args.threads)
    network, metadata = load_checkpoint(args.weights)
    with process_group() as rank:
        data = _data(args, rank)
        for line in data.describe() if rank == 0 else ():
            print(line)
        config = TrainConfig(
            steps=args.steps,
            batch=args.batch,
            seed=args.seed,
            lr=args.lr,
            encoder_lr=args.lr / 5,
            frozen_stages=14 if args.freeze_encoder else 4,
            freeze_norm=True,
            warmup_steps=min(20, args.steps // 4),
            ema_decay=0.99,
            validate_every=max(args.steps // 8, 1),
            checkpoint_every=max(args.steps // 8, 1),
            patience=args.patience,
            amp=args.amp,
        )
        result = finetune(network, metadata, data, config, args.out, FromRuns(args.from_runs))
    if rank == 0:
        print(result.describe())
    return 0


def _data(args: argparse.Namespace, rank: int) -> "Data":
    """Sort the folders by what they hold; unlabelled recordings are sent through the SLAM first."""
    from edgeslam_torch.train.datasets import has_depth, load_depth_folder
    from edgeslam_torch.train.distributed import wait_for_first
    from edgeslam_torch.train.finetune import Data
    from edgeslam_torch.train.posed import is_run_folder, load_run

    data = Data()
    for folder in args.data:
        if not folder.exists():
            raise SourceError(f"{folder}: no such recording or folder")
        if is_run_folder(folder):
            data.posed.append(load_run(folder))
        elif has_depth(folder) and not args.ignore_depth:
            data.labelled.append(load_depth_folder(folder, max_frames=args.max_frames))
        else:
            run_folder = args.out / "slam" / folder.name
            with wait_for_first(rank):
                if not is_run_folder(run_folder):
                    _run_slam(folder, run_folder, args)
            data.posed.append(load_run(run_folder))
    for folder in args.validate:
        data.validation.append(load_depth_folder(folder, width=640))
    return data


def _run_slam(folder: Path, out: Path, args: argparse.Namespace) -> None:
    from edgeslam_torch.config import DepthConfig, SlamConfig
    from edgeslam_torch.io.source import open_source
    from edgeslam_torch.run import run

    config = SlamConfig()
    if args.weights is not None:
        config = replace(config, depth=DepthConfig(weights=str(args.weights)))
    run(open_source(folder, args.camera, max_frames=args.max_frames), out, config)
