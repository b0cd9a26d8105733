"""What commands that run the pipeline share: their options, the settings these make, and what is said at the end."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.run import RunResult

EXIT_INTERRUPTED = 130


def add_settings(parser: argparse.ArgumentParser, of: str = "") -> None:
    """Declare depth network, device and settings, which `resolved_config` reads.

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


def resolved_config(args: argparse.Namespace) -> "SlamConfig":
    """Defaults overridden by ``--config``, ``--set`` and named options, in this order."""
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.files.config_file import load_config

    config = load_config(SlamConfig(), args.config, args.set)
    if args.seed is not None:
        try:
            config = replace(config, seed=args.seed)
        except ValueError as error:
            raise ConfigError(f"--seed: {error}") from error
    given = {name: value for name, value in (("weights", args.depth), ("device", args.device)) if value is not None}
    return replace(config, depth=replace(config.depth, **given))


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


def say(text: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"edgeslam: {text}\n")


def check_tracked(result: "RunResult") -> None:
    """A run that tracked nothing is no success.

    Raises:
        SourceError: If no frame was tracked.
    """
    from edgeslam_torch.errors import SourceError

    if not result.summary["tracked"]:
        raise SourceError(
            f"no frame was tracked against a map ({result.summary['last_reason'] or 'no reason known'}): the poses in "
            f"{result.folder} are guesses; the camera must move sideways, up or down, and see something with texture"
        )


def write_page(result: "RunResult") -> None:
    """``report.html``; failure to make the page does not fail the run."""
    from edgeslam_torch.errors import EdgeSlamError
    from edgeslam_torch.eval.report.page import write_report

    try:
        write_report(result.folder, judge_map=False)
    except (EdgeSlamError, OSError, ValueError) as error:
        say(f"warning: report.html could not be made ({error})")
