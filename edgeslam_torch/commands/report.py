"""``edgeslam report``: write the self-contained page of a run, or of two runs side by side."""

import argparse
from pathlib import Path

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.output_file import add_overwrite_to, check_new, output_file

COMPARISON = "comparison.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("runs", nargs="+", type=Path, help="output folders of 'edgeslam run'")
    parser.add_argument(
        "--groundtruth",
        "-g",
        type=Path,
        help="data set folder or trajectory file (default: the run's own source, when it has ground truth)",
    )
    parser.add_argument(
        "--no-map-score", action="store_true", help="do not compare the map with measured depth (faster)"
    )
    parser.add_argument(
        "--out",
        type=output_file,
        metavar="FILE",
        help=f"page of two runs side by side (default: {COMPARISON} beside the first of two)",
    )
    add_overwrite_to(parser)


def main(args: argparse.Namespace) -> int:
    """Write each report, and the comparison of two; print their paths."""
    from edgeslam_torch.terminal.progress import Progress

    if args.out is not None and len(args.runs) != 2:
        raise ConfigError(f"--out is for the comparison of two runs, got {len(args.runs)}")
    from edgeslam_torch.eval.report.page import write_report

    with Progress("making the report"):
        for run in args.runs:
            if len(args.runs) == 2 and run.is_file():
                continue  # a trajectory alone has no report, but can be compared
            _say(write_report(run, args.groundtruth, judge_map=not args.no_map_score))
        if len(args.runs) == 2:
            _say(_compared(args))
    return 0


def _compared(args: argparse.Namespace) -> Path:
    from edgeslam_torch.eval.report.comparison import write_comparison

    first, second = args.runs
    out: Path = args.out if args.out is not None else first.resolve().parent / COMPARISON
    check_new(out, args.overwrite)
    return write_comparison(first, second, out, args.groundtruth, judge_map=not args.no_map_score)


def _say(path: Path) -> None:
    print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
