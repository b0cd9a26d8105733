"""``edgeslam``: the command line. Nothing heavy is imported until a command needs it."""

import argparse
import difflib
import importlib
import importlib.util
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from edgeslam_torch import __version__
from edgeslam_torch.errors import EdgeSlamError

COMMANDS = {
    "demo": ("edgeslam_torch.commands.demo", "fly a simulated drone through a simulated house; needs no data"),
    "run": ("edgeslam_torch.commands.run", "trajectory and edge map from a recording, a video or a live camera"),
    "eval": ("edgeslam_torch.commands.eval", "judge runs or trajectory files against ground truth"),
    "bench": ("edgeslam_torch.commands.bench", "accuracy and speed in one table, beside other systems"),
    "judge": ("edgeslam_torch.commands.judge", "every recording, variant and simulated flight in one table with bars"),
    "ablation": ("edgeslam_torch.commands.ablation", "what each loss does: one table, one thing changed at a time"),
    "report": ("edgeslam_torch.commands.report", "make the report page of a run"),
    "view": ("edgeslam_torch.commands.view", "open a run's report or viewer"),
    "depth": ("edgeslam_torch.commands.depth", "depth maps of images, folders or videos"),
    "finetune": ("edgeslam_torch.commands.finetune", "train the depth network on your own recordings"),
    "export": ("edgeslam_torch.commands.export", "depth network to ONNX for the companion computer"),
    "weights": ("edgeslam_torch.commands.weights", "list, download, convert and inspect network weights"),
    "record": ("edgeslam_torch.commands.record", "record a flight or a camera"),
    "calibrate": ("edgeslam_torch.commands.calibrate", "camera calibration from chessboard pictures"),
    "sim": ("edgeslam_torch.commands.sim", "a simulated Tello on this machine's loopback"),
    "export-map": ("edgeslam_torch.commands.export_map", "edge map to PLY, PCD, COLMAP or an occupancy grid"),
}
"""Name: (module, one line of help). A command whose module is not there is not offered."""

EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """Says what the user may have meant; no option can be abbreviated, so that adding one breaks no script."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """One line, and exit."""
        sys.stderr.write(f"{self.prog}: error: {message}; see {self.prog} --help\n")
        sys.exit(EXIT_USAGE)

    def options(self) -> list[str]:
        """Every option that can be given."""
        return [name for action in self._actions for name in action.option_strings]


def available() -> dict[str, tuple[str, str]]:
    """The commands that this installation has."""
    return {name: entry for name, entry in COMMANDS.items() if importlib.util.find_spec(entry[0]) is not None}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands = available()
    parser = _top_parser(commands)
    split = next((i for i, word in enumerate(arguments) if not word.startswith("-")), len(arguments))
    top, unknown = parser.parse_known_args(arguments[:split])
    if unknown:
        parser.error(_unknown_arguments(unknown, parser.options()))
    if split == len(arguments):
        parser.print_help()
        return EXIT_USAGE
    name, rest = arguments[split], arguments[split + 1 :]
    if name not in commands:
        parser.error(_unknown_command(name, commands))
    verbose = top.verbose or any(word in ("-v", "--verbose") for word in rest)
    _quiet_libraries(verbose)
    try:
        return _call(name, commands[name], rest, verbose)
    except EdgeSlamError as error:
        if verbose:
            raise
        sys.stderr.write(f"edgeslam: error: {_one_line(error)}\n")
        return EXIT_ERROR
    except KeyboardInterrupt:
        sys.stderr.write("edgeslam: interrupted\n")
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of a pipe, such as head, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _call(name: str, entry: tuple[str, str], arguments: list[str], verbose: bool) -> int:
    module = importlib.import_module(entry[0])
    parser = Parser(prog=f"edgeslam {name}", description=(module.__doc__ or entry[1]).strip().splitlines()[0])
    module.add_arguments(parser)
    if "--verbose" not in parser.options():
        parser.add_argument("-v", "--verbose", action="store_true", help="debug messages, and tracebacks of errors")
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(_unknown_arguments(unknown, parser.options()))
    with _messages(verbose):
        return int(module.main(args))


def _top_parser(commands: dict[str, tuple[str, str]]) -> Parser:
    width = max((len(name) for name in commands), default=0)
    listing = "\n".join(f"  {name:<{width}}  {entry[1]}" for name, entry in commands.items())
    parser = Parser(
        prog="edgeslam",
        usage="edgeslam [-v] COMMAND ...",
        description="Metric monocular SLAM with a semi-dense edge map.",
        epilog=f"commands:\n{listing}\n\n'edgeslam COMMAND --help' tells the options of one.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"edgeslam {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="debug messages, and tracebacks of errors")
    return parser


def _unknown_command(name: str, commands: dict[str, tuple[str, str]]) -> str:
    close = difflib.get_close_matches(name, commands, n=1, cutoff=0.5)
    if close:
        return f"no command {name!r}; did you mean {close[0]!r}?"
    if os.path.exists(name):
        return f"no command {name!r}; did you mean 'edgeslam run {name}'?"
    return f"no command {name!r}; there are {', '.join(commands)}"


def _unknown_arguments(unknown: list[str], options: list[str]) -> str:
    word = unknown[0]
    if not word.startswith("-"):
        return f"unexpected {word!r}"
    option = word.split("=", 1)[0]
    close = difflib.get_close_matches(option, options, n=1, cutoff=0.5)
    return f"no option {option!r}" + (f"; did you mean {close[0]!r}?" if close else "")


@contextmanager
def _messages(verbose: bool) -> Iterator[None]:
    """Our own messages on stderr while a command runs: warnings, or everything."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.DEBUG if verbose else logging.WARNING)
    pattern = "%(asctime)s %(name)s %(levelname)s %(message)s" if verbose else "edgeslam: %(levelname)s: %(message)s"
    handler.setFormatter(logging.Formatter(pattern))
    ours = logging.getLogger("edgeslam_torch")
    before = ours.level
    ours.addHandler(handler)
    ours.setLevel(handler.level)
    try:
        yield
    finally:
        ours.removeHandler(handler)
        ours.setLevel(before)


def _quiet_libraries(verbose: bool) -> None:
    """OpenCV and FFmpeg report damaged images themselves, on top of what we say about them."""
    if not verbose:
        os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
