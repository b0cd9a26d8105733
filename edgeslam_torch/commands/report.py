"""``edgeslam report``: write the self-contained page of a run."""

import argparse
from pathlib import Path

from edgeslam_torch.errors import OutputError


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


def main(args: argparse.Namespace) -> int:
    """Write each report and print its path."""
    from edgeslam_torch.eval.report.page import write_report

    for run in args.runs:
        try:
            path = write_report(run, args.groundtruth, judge_map=not args.no_map_score)
        except OSError as error:
            raise OutputError(f"{run / 'report.html'}: cannot be written ({error.strerror or error})") from error
        print(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0
