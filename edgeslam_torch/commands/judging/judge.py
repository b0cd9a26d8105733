"""Every recording, its variants and simulated flights, each in its own process, as one table with limits."""

import argparse
import json
from pathlib import Path

from edgeslam_torch.commands.judging._common import recordings, say
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.output_file import add_overwrite_to, check_new, check_not_read
from edgeslam_torch.help.options import add_set, positive_amount, positive_number, whole_number

CELLS = ("base", "variants", "flights", "telemetry", "imu", "all")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "data", nargs="?", type=Path, metavar="DATA", help="folder of recordings (default: EDGESLAM_DATA)"
    )
    parser.add_argument(
        "--only", action="append", default=[], metavar="GLOB", help="only cells whose names match; may be repeated"
    )
    parser.add_argument(
        "--cells",
        choices=CELLS,
        default="base",
        help="recordings as they are, their variants, simulations, simulated telemetry or IMU, or all (default: base)",
    )
    parser.add_argument("--seeds", type=positive_number, default=1, metavar="N", help="runs of every cell (default: 1)")
    parser.add_argument("--first-seed", type=whole_number, default=0, metavar="N", help="of those runs (default: 0)")
    parser.add_argument("--jobs", type=positive_number, default=2, metavar="N", help="processes at a time (default: 2)")
    parser.add_argument(
        "--timeout", type=positive_amount, default=900.0, metavar="S", help="of one cell (default: 900)"
    )
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop every run after N frames")
    add_set(parser)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="results; finished cells are not repeated"
    )
    parser.add_argument(
        "--release",
        type=Path,
        metavar="FILE.json",
        help="instead run what the documents quote, and write its figures here (docs/results)",
    )
    add_overwrite_to(parser)
    parser.add_argument("--flights", type=Path, metavar="DIR", help="cache of simulated flights (default: in --out)")
    parser.add_argument("--thresholds", type=Path, metavar="FILE", help="limits to check (default: the project's own)")
    parser.add_argument("--against", type=Path, metavar="DIR", help="also compare with another judge's --out")


def main(args: argparse.Namespace) -> int:
    """Run the missing cells, print and write the table; 1 when a cell has no result."""
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.eval.experiment.figures import compared, read_record
    from edgeslam_torch.eval.judge.cells import list_cells
    from edgeslam_torch.eval.judge.release import command_outputs, is_release, release_cells, release_record
    from edgeslam_torch.eval.judge.runner import FORMAT, RECORD, TABLE, JudgeSettings, judge
    from edgeslam_torch.eval.judge.score import COLUMNS
    from edgeslam_torch.eval.judge.table import THRESHOLDS, markdown, read_thresholds
    from edgeslam_torch.files.config_file import load_config

    load_config(SlamConfig(), None, args.set)  # a setting that does not exist is said before anything is run
    data = recordings(args.data)
    thresholds = read_thresholds(args.thresholds or THRESHOLDS)
    before = read_record(args.against / RECORD, "judge", (FORMAT,), "rows") if args.against is not None else None
    if args.release is not None and (args.only or args.set or args.max_frames):
        raise ConfigError("--release runs its own cells with default settings: omit --only, --set and --max-frames")
    if args.release is not None:
        read = [path for path in (data, args.thresholds, args.against, args.flights) if path is not None]
        check_not_read(args.release, read, "--release")
        check_new(args.release, args.overwrite or is_release(args.release), "--release")
        cells = release_cells(data)
        say(f"release: {len(cells)} runs; call it again to resume after an interruption")
    else:
        cells = list_cells(data, args.cells, range(args.first_seed, args.first_seed + args.seeds), args.only)
    settings = JudgeSettings(tuple(args.set), args.max_frames, args.jobs, args.timeout, args.flights)
    record = judge(cells, settings, args.out, say)
    text = markdown(record, thresholds)
    if before is not None:
        text += "\n" + compared(before, record, "rows", "cell", COLUMNS)
    write_text(args.out / RECORD, json.dumps(record, indent=1) + "\n")
    write_text(args.out / TABLE, text)
    if args.release is not None:
        assert data is not None
        outputs = command_outputs(data, args.out, record["commit"], say)
        release = release_record(record["rows"], record["commit"], outputs)
        write_text(args.release, json.dumps(release, indent=1) + "\n")
    print(text)
    print(f"results: {args.out / RECORD}")
    return 1 if any(row["error"] for row in record["rows"]) else 0
