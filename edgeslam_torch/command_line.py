"""Command-line parsing: find the command, parse its options, run it, report errors in one line."""

import argparse
import difflib
import importlib
import logging
import os
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from types import ModuleType

from edgeslam_torch import __version__
from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.files.output_file import add_overwrite, check_outputs, parsers_of
from edgeslam_torch.help.pages import describe_verbs, described, listing
from edgeslam_torch.help.parser import EXIT_USAGE, Parser
from edgeslam_torch.terminal.console import console, exit_code

Commands = Mapping[str, tuple[str, str]]
"""Name: (module, one line of help)."""

EXIT_ERROR = 1
_MOST_SHOWN = 2000
"""Maximum length of an error message [characters]: names in hostile files may be arbitrarily long."""


def run_command(arguments: list[str], commands: Commands) -> int:
    """Run one of the commands; returns the exit code."""
    with console() as (out, err):
        try:
            code = _run_command(arguments, commands)
        except SystemExit as end:
            if end.code:
                raise
            code = 0  # --help
        out.flush()
        return exit_code(code, out, err)


def _run_command(arguments: list[str], commands: Commands) -> int:
    parser = _top_parser(commands)
    values = {i + 1 for i, word in enumerate(arguments) if word == "--print-completion"}
    words = (i for i, word in enumerate(arguments) if not word.startswith("-") and i not in values)
    split = next(words, len(arguments))
    top, unknown = parser.parse_known_args(arguments[:split])
    if unknown:
        parser.error(_unknown_arguments(unknown, parser.options()))
    if top.print_completion is not None:
        import shtab

        print(shtab.complete(full_parser(commands), top.print_completion))
        return 0
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
    except (EdgeSlamError, OSError) as error:
        if verbose:
            raise
        sys.stderr.write(f"edgeslam: error: {_one_line(error)}\n")
        return EXIT_ERROR


def _call(name: str, entry: tuple[str, str], arguments: list[str], verbose: bool) -> int:
    module = importlib.import_module(entry[0])
    parser = Parser(prog=f"edgeslam {name}", **described(name, module.__doc__ or entry[1]))
    _add_arguments(name, parser, module)
    args, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(_unknown_arguments(unknown, parser.options()))
    check_outputs(parser, args)
    _check_plain(args)
    with _messages(verbose):
        return int(module.main(args))


def _check_plain(args: argparse.Namespace) -> None:
    """Refuse pipes, sockets and devices by name: reading one may never end.

    Raises:
        SourceError: If an option or argument names one.
    """
    for given in vars(args).values():
        for value in given if isinstance(given, list | tuple) else (given,):
            if isinstance(value, str | os.PathLike):
                for name in {os.fspath(value), os.fspath(value).rpartition("=")[2]}:
                    with suppress(OSError, ValueError):
                        kind = os.stat(name).st_mode
                        if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
                            raise SourceError(f"{name}: is neither a regular file nor a folder")


def _add_arguments(name: str, parser: Parser, module: ModuleType) -> None:
    module.add_arguments(parser)
    describe_verbs(name, parser)
    add_overwrite(parser)
    for each in parsers_of(parser):
        if "--verbose" not in each._option_string_actions:
            each.add_argument("-v", "--verbose", action="store_true", help="debug messages, and tracebacks of errors")


def full_parser(commands: Commands) -> Parser:
    """All commands with all their options in one parser, for completion and other static tools."""
    parser = _top_parser(commands)
    below = parser.add_subparsers(metavar="COMMAND")
    for name, entry in commands.items():
        module = importlib.import_module(entry[0])
        command = below.add_parser(name, help=entry[1], **described(name, module.__doc__ or entry[1]))
        _add_arguments(name, command, module)
    return parser


def _top_parser(commands: Commands) -> Parser:
    parser = Parser(
        prog="edgeslam",
        usage="edgeslam [-v] COMMAND ...",
        description="Metric monocular SLAM with a semi-dense edge map.",
        epilog=f"commands:\n\n{listing(commands)}\n\n'edgeslam COMMAND --help' lists options and examples of one.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"edgeslam {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="debug messages, and tracebacks of errors")
    parser.add_argument(
        "--print-completion", choices=("bash", "zsh", "tcsh"), help="print a completion script for this shell, and exit"
    )
    return parser


def _unknown_command(name: str, commands: Commands) -> str:
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
    close = [o for o in options if o.startswith(option)] or difflib.get_close_matches(option, options, 1, 0.5)
    return f"no option {option!r}" + (f"; did you mean {close[0]!r}?" if close else "")


@contextmanager
def _messages(verbose: bool) -> Iterator[None]:
    """Log our messages to stderr while a command runs: warnings, or everything."""
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
    """OpenCV and FFmpeg report damaged images themselves, in addition to our messages."""
    if not verbose:
        os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def _one_line(error: Exception) -> str:
    """What went wrong; of what the system refused the file and the reason, neither of them pages long."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror is not None:
        text = f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    words = " ".join(text.split()) or type(error).__name__
    return words if len(words) <= _MOST_SHOWN else f"{words[: _MOST_SHOWN // 2]} ... {words[-_MOST_SHOWN // 2 :]}"
