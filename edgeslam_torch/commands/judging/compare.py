"""``edgeslam compare``: every figure of two runs or trajectory files side by side, against one ground truth."""

import argparse
import json
from pathlib import Path

from edgeslam_torch.commands.judging.eval import groundtruth_of, one_groundtruth
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.output_file import output_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("first", type=Path, metavar="A", help="output folder of 'edgeslam run', or a trajectory file")
    parser.add_argument("second", type=Path, metavar="B", help="the other one")
    parser.add_argument(
        "--groundtruth",
        "-g",
        type=Path,
        metavar="FILE|DIR",
        help="data set folder or trajectory file (default: that of the recording which the runs read)",
    )
    parser.add_argument("--max-dt", type=float, default=0.02, metavar="S", help="maximum time between matched poses")
    parser.add_argument("--offset", type=float, default=0.0, metavar="S", help="added to the stamps of both")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures here")


def main(args: argparse.Namespace) -> int:
    """Print the table of differences."""
    from edgeslam_torch.eval.inputs.run_folder import open_run
    from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
    from edgeslam_torch.eval.metrics.run_score import evaluate_run
    from edgeslam_torch.eval.metrics.trajectory_error import score_common
    from edgeslam_torch.eval.report.tables import common_report, report_of_two
    from edgeslam_torch.terminal.progress import counted

    both = (args.first, args.second)
    known = [truth for run in both if (truth := args.groundtruth or open_run(run).own_truth) is not None]
    truth = one_groundtruth(known or [groundtruth_of(args.first, None)])
    shown = counted(both, "judging trajectories and maps", "run")
    first, second = (evaluate_run(run, truth, max_dt_s=args.max_dt, offset_s=args.offset) for run in shown)
    names = zip("AB", both, strict=True)
    common = score_common(
        read_trajectory(truth), [(name, read_trajectory(run)) for name, run in names], args.max_dt, args.offset
    )
    print(report_of_two(first, second))
    print(common_report(common))
    if args.json is not None:
        write_text(args.json, json.dumps([first.to_dict(), second.to_dict()], indent=1, default=str) + "\n")
    return 0
