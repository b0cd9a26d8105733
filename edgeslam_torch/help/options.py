"""Options that several commands have, their types, and how commands speak."""

import argparse
import math
import sys
from pathlib import Path

EXIT_INTERRUPTED = 130


def add_settings(parser: argparse.ArgumentParser, of: str = "") -> None:
    """Declare depth network, device and settings, which `edgeslam_torch.commands.run.resolved_config` reads.

    Args:
        parser: Of the command.
        of: Whose they are, such as `` of all flights``.
    """
    parser.add_argument(
        "--depth",
        metavar="FILE|NAME|none",
        help=f"depth network{of}: weights, near, an ONNX file, a downloaded network, or none",
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda", "mps"),
        help="where the depth network runs; all else is computed on the processor (default: cpu)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help=f"settings{of}; a run's config.toml is one")
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Declare ``--set``."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="change one setting, such as orb.features=1500; may be repeated",
    )


def add_topic(parser: argparse.ArgumentParser, words: str) -> None:
    """Declare ``--topic``."""
    parser.add_argument("--topic", action="append", default=[], metavar="[ROLE=]NAME", help=f"{words}; may be repeated")


def whole_number(text: str, least: int = 0) -> int:
    """Argument type for counts."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not least <= value < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, got {text[:40]!r}")
    return value


def positive_number(text: str) -> int:
    """Argument type for counts of at least one."""
    return whole_number(text, 1)


def positive_amount(text: str) -> float:
    """Argument type for times and sizes."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a positive number, got {text[:40]!r}")
    return value


def say(text: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"edgeslam: {text}\n")
