"""Files that the user names for a command to write: nothing is replaced without --overwrite.

One rule for every command: what exists is replaced with ``--overwrite`` alone, and what the command reads never, by
whatever name or hard link it is given; nothing is added to a recording. Folders have a rule of their own,
`edgeslam_torch.writers.own_folder`.
"""

import argparse
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.record_files import read_mapping, recording_of

RECORDING = ("rgb.txt", "rgb", "mav0", "cam0", "data.csv", "sensor.yaml", "ost.yaml", "telemetry.csv")
"""Names that only files and folders of recordings have."""
_PARTS = re.compile(
    r"trajectory.*\.txt|status\.csv|summary\.json|(edge_map|anchors)\.ply|observations\.npz"
    r"|(rgb|depth|times|groundtruth|accelerometer)\.txt|(telemetry|imu|data)\.csv|(camera|imu|sensor|metadata)\.yaml"
    r"|.*\.(bag|db3|mcap)"
)
"""Names of the files that runs and recordings consist of."""
_PICTURE = re.compile(r"(?i).*\.(png|jpe?g|bmp|tiff?|p[gp]m|webp|mp4|mov|avi|mkv)")
"""Those of recordings that lie in folders of their own."""

STDOUT = Path("-")
"""Printed, where a command offers it."""


def output_file(text: str) -> Path:
    """Argument type of such a file: `add_overwrite` and `check_outputs` find options by it."""
    return Path(text)


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """Declare ``--overwrite`` where a file to write can be named."""
    for each in parsers_of(parser):
        if any(action.type is output_file for action in each._actions):
            add_overwrite_to(each)


def add_overwrite_to(parser: argparse.ArgumentParser) -> None:
    """Declare ``--overwrite``, once."""
    if "--overwrite" not in parser._option_string_actions:
        parser.add_argument("--overwrite", action="store_true", help="replace files that exist")


def check_outputs(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Check all files to write, before anything is done.

    Raises:
        OutputError: If one exists and may not be replaced.
    """
    actions = {a.dest: a for each in parsers_of(parser) for a in each._actions if a.type is output_file}
    read = [path for name, value in vars(args).items() if name not in (*actions, "out") for path in _paths(value)]
    named: list[Path] = []
    for dest, action in actions.items():
        path: Path | None = getattr(args, dest, None)
        if path is None or path == STDOUT:
            continue
        option = max(action.option_strings, key=len)
        if any(_same(path, other) for other in named):
            raise OutputError(f"{path}: given twice; give another file to {option}")
        named.append(path)
        made = action.default is not None and path.name == action.default.name  # by an earlier call
        check_not_read(path, read, option, made)
        check_new(path, args.overwrite, option)


def check_not_read(path: Path, read: Sequence[str | Path], option: str, made: bool = False) -> None:
    """Check that a file to write is none of those read, and would be no part of a recording, or of a run among them.

    Args:
        path: The file.
        read: Files and folders that the command reads; with a run, the recording that it is of.
        option: Where the file comes from.
        made: Whether a file of this name is what the command makes and not what it reads.

    Raises:
        OutputError: If it is.
    """
    read = [*read, *(recording for run in read if (recording := _recording_of(Path(run))) is not None)]
    places = [path]
    is_picture = _PICTURE.fullmatch(path.name) is not None
    is_part = not made and (is_picture or _PARTS.fullmatch(path.name) is not None)
    if is_part:
        places += path.parents if is_picture and path.exists() else [path.parent]
    if any(_same(place, other) for other in read for place in places):
        raise OutputError(f"{path}: is what the command reads, or part of it; give another file to {option}")
    if is_part and (beside := next((name for name in RECORDING if (path.parent / name).exists()), None)):
        raise OutputError(f"{path}: would lie beside {beside} of a recording; give another file to {option}")


def check_new(path: Path, overwrite: bool, option: str = "--out") -> None:
    """Check that a file may be written.

    Args:
        path: The file.
        overwrite: Whether it may be replaced.
        option: Where it comes from.

    Raises:
        OutputError: If it exists and may not be replaced, or is a folder.
    """
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give a file to {option}")
    if os.path.lexists(path) and not overwrite:
        raise OutputError(f"{path}: exists; give another file to {option}, or --overwrite to replace it")


def parsers_of(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parser, and those of its verbs."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from parsers_of(inner)


def _paths(value: Any) -> Iterator[str | Path]:
    if isinstance(value, str | Path):
        yield value
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _paths(item)


def _recording_of(run: Path) -> Path | None:
    try:
        return recording_of(run, read_mapping(run / "summary.json", "JSON", OutputError))
    except (OutputError, ValueError):  # no run, or no name of one
        return None


def _same(path: Path, other: str | Path) -> bool:
    try:
        return os.path.realpath(path) == os.path.realpath(other) or os.path.samefile(path, other)
    except (OSError, ValueError):  # no file, or no name of one
        return False
