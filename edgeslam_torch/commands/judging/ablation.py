"""Ablation: the benchmark with one change at a time, as one table."""

import argparse
import os
import sys
import time
from pathlib import Path

from edgeslam_torch.errors import OutputError, SourceError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.output_file import output_file


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
        "--out", type=Path, metavar="DIR", help="folder for the results; finished runs are not repeated"
    )
    parser.add_argument("--markdown", type=output_file, metavar="FILE", help="also write the tables here")


def main(args: argparse.Namespace) -> int:
    """Run all variants and print the table."""
    from edgeslam_torch.eval.benchmark.ablation import AblationSettings, markdown_ablation, run_ablation

    data = args.data or (Path(os.environ["EDGESLAM_DATA"]) if os.environ.get("EDGESLAM_DATA") else None)
    if data is None:
        raise SourceError("no recordings: give --data or set EDGESLAM_DATA")
    settings = AblationSettings(
        data=data,
        seeds=tuple(range(max(1, args.seeds))),
        sequences=tuple(args.sequence),
        rows=tuple(args.row),
        max_frames=args.max_frames,
        overrides=tuple(args.set),
    )
    out = args.out or Path("runs") / time.strftime("ablation-%Y%m%d-%H%M%S")
    try:
        text = markdown_ablation(run_ablation(settings, out, _say))
        if args.markdown is not None:
            write_text(args.markdown, text)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written ({error.strerror or error})") from error
    print(text)
    print(f"results: {out / 'ablation.json'}")
    return 0


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
