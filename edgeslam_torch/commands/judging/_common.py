"""What the commands that run experiments share."""

import argparse
import os
import sys
from pathlib import Path

from edgeslam_torch.files.output_file import output_file
from edgeslam_torch.help.options import add_set, positive_number


def add_runs_to(parser: argparse.ArgumentParser, seeds: int) -> None:
    """Declare the options of commands that run sequences of a folder with several seeds."""
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of recordings (default: EDGESLAM_DATA)")
    parser.add_argument("--seeds", type=positive_number, default=seeds, metavar="N", help=f"runs (default: {seeds})")
    parser.add_argument(
        "--sequence", action="append", default=[], metavar="NAME", help="only this one; may be repeated"
    )
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop every run after N frames")
    add_set(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="results; finished runs are not repeated (default: runs/NAME-TIME)"
    )
    parser.add_argument("--markdown", type=output_file, metavar="FILE", help="also write the tables here")


def recordings(given: Path | None) -> Path | None:
    """Folder of recordings: the given one, else ``EDGESLAM_DATA``, if any."""
    return given or (Path(os.environ["EDGESLAM_DATA"]) if os.environ.get("EDGESLAM_DATA") else None)


def say(text: str) -> None:
    """One line of progress."""
    sys.stderr.write(text + "\n")
