"""What each loss does: the benchmark with one thing changed at a time, as one table."""

import argparse
import json
import os
import sys
import time
from pathlib import Path

from edgeslam_torch.errors import OutputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of recordings (default: EDGESLAM_DATA)")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="runs of every row (default: 2)")
    parser.add_argument(
        "--sequence", action="append", default=[], metavar="NAME", help="only this one; may be repeated"
    )
    parser.add_argument("--row", action="append", default=[], metavar="NAME", help="only this row; may be repeated")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop every run after N frames")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change all rows")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the runs; rows that it holds already are not run again"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results here")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write the tables here")


def main(args: argparse.Namespace) -> int:
    """Run the rows; 1 when a run failed."""
    from edgeslam_torch.eval.ablation import markdown_ablation, run_ablation
    from edgeslam_torch.eval.benchmark import BenchSettings

    data = args.data or (Path(os.environ["EDGESLAM_DATA"]) if os.environ.get("EDGESLAM_DATA") else None)
    settings = BenchSettings(
        data=data,
        seeds=tuple(range(max(1, args.seeds))),
        only=tuple(args.sequence),
        max_frames=args.max_frames,
        overrides=tuple(args.set),
        micro=False,
    )
    if data is None:
        _say("no recordings (--data or EDGESLAM_DATA): the synthetic flight alone")
    out = args.out or Path("runs") / time.strftime("ablation-%Y%m%d-%H%M%S")
    try:
        records = run_ablation(settings, args.row, out, _say)
        text = markdown_ablation(records)
        if args.json is not None:
            args.json.write_text(json.dumps(records, indent=1, default=str) + "\n", encoding="utf-8")
        if args.markdown is not None:
            args.markdown.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written ({error.strerror or error})") from error
    print(text)
    return 1 if any(run["error"] for record in records.values() for run in record["runs"]) else 0


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
