"""Ablation: the benchmark with one change at a time, as one table."""

import argparse
import time
from pathlib import Path

from edgeslam_torch.commands.judging._common import add_runs_to, recordings, say
from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_runs_to(parser, seeds=2)
    parser.add_argument("--row", action="append", default=[], metavar="NAME", help="only this row; may be repeated")


def main(args: argparse.Namespace) -> int:
    """Run all variants and print the table; 1 when a run failed."""
    from edgeslam_torch.eval.benchmark.benchmark import BenchSettings
    from edgeslam_torch.eval.benchmark.rows import markdown_ablation, run_ablation

    data = recordings(args.data)
    if data is None:
        raise SourceError("no recordings: give --data or set EDGESLAM_DATA")
    seeds = tuple(range(args.seeds))
    settings = BenchSettings(data, seeds, tuple(args.sequence), args.max_frames, overrides=tuple(args.set), min_hz=0.0)
    out = args.out or Path("runs") / time.strftime("ablation-%Y%m%d-%H%M%S")
    record = run_ablation(settings, args.row, out, say)
    text = markdown_ablation(record)
    if args.markdown is not None:
        write_text(args.markdown, text)
    print(text)
    print(f"results: {out / 'ablation.json'}")
    return 1 if any(run["error"] for row in record["rows"].values() for run in row["runs"]) else 0
