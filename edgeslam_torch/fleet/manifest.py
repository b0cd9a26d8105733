"""What a batch runs on: folders, globs and CSV tables of recordings become a list of flights."""

import difflib
import glob
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.files.tables import Row, read_table
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.readers import video
from edgeslam_torch.readers.images import image_files
from edgeslam_torch.readers.layouts import layout_of
from edgeslam_torch.readers.source import LIVE_SCHEMES

COLUMNS = ("recording", "name", "camera", "telemetry", "topic", "truth", "settings")
"""Of a CSV table; only the first must be there."""
_MAX_NAME = 80
_FILES = (video.SUFFIXES - video.PREVIEWS) | {".bag", ".db3", ".mcap"}
"""Files in a folder that are recordings by themselves."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One recording of a batch."""

    recording: Path
    name: str
    """Of its results; no two flights of a batch have the same."""
    camera: str = ""
    """Calibration file or preset; the recording's own when empty."""
    telemetry: str = ""
    """Telemetry file; the recording's own when empty."""
    topics: tuple[str, ...] = ()
    """Of a ROS bag to use, as ``edgeslam run --topic`` takes them; chosen by type when empty."""
    truth: str = ""
    """Data set folder or trajectory file; what the recording itself has when empty."""
    settings: tuple[str, ...] = ()
    """``section.key=value`` over the batch's own."""
    origin: str = ""
    """Where the manifest names it, for messages."""


def read_manifests(manifests: Sequence[str]) -> list[Flight]:
    """Flights of all manifests, in order; names that appear again are numbered.

    A folder that is a recording is one flight; of any other folder every folder and video in it is one, also what
    turns out to be no recording. A table is a ``.csv`` file; its relative paths start at its folder.

    Args:
        manifests: Folders, recordings, patterns such as ``flights/*``, or tables.

    Raises:
        SourceError: If one does not exist or names no recording.
        ConfigError: If a table is malformed.
    """
    flights: list[Flight] = []
    for manifest in manifests:
        flights += _flights_of(manifest)
    return _told_apart(flights)


def _flights_of(manifest: str) -> list[Flight]:
    if manifest.startswith(LIVE_SCHEMES):
        raise SourceError(f"{manifest}: a batch takes recordings, not live sources")
    path = Path(manifest).expanduser()
    if path.is_dir():
        return _of_folder(path)
    if path.suffix.lower() == ".csv" and path.is_file():
        return _of_table(path)
    if path.exists():
        return [_flight(path)]
    if not glob.has_magic(str(path)):
        raise SourceError(f"{manifest}: no such folder, recording or table")
    found = [p for p in map(Path, sorted(glob.glob(str(path)))) if _may_be_recording(p)]
    if not found:
        raise SourceError(f"{manifest}: no folder or video matches")
    return [_flight(p) for p in found]


def _of_folder(folder: Path) -> list[Flight]:
    if layout_of(folder) is not None or image_files(folder):
        return [_flight(folder)]
    found = [path for path in sorted(folder.iterdir()) if _may_be_recording(path)]
    if not found:
        raise SourceError(f"{folder}: no folders or videos in it; give a folder of recordings, a pattern or a table")
    return [_flight(path) for path in found]


def _may_be_recording(path: Path) -> bool:
    return not path.name.startswith(".") and (path.is_dir() or path.suffix.lower() in _FILES)


def _flight(recording: Path) -> Flight:
    return Flight(recording, _plain(recording.resolve().name), origin=str(recording))


def _of_table(table: Path) -> list[Flight]:
    content = read_table(table, ConfigError)
    if not content.rows:
        raise ConfigError(f"{table}: no recording in it; its first line is {','.join(COLUMNS)}, or some of these")
    _check_columns(table, content.header)
    return [_of_row(table, content.header, row) for row in content.rows]


def _check_columns(table: Path, names: Iterable[str]) -> None:
    for name in names:
        if name not in COLUMNS:
            close = difflib.get_close_matches(name, COLUMNS, n=1)
            hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(COLUMNS)}"
            raise ConfigError(f"{table}: unknown column {name[:60]!r}{hint}")
    if "recording" not in names:
        raise ConfigError(f"{table}: no column 'recording'; its first line is {','.join(COLUMNS)}, or some of these")


def _of_row(table: Path, header: Sequence[str], row: Row) -> Flight:
    origin = f"{table}, line {row.line}"
    if len(row.cells) > len(header):
        raise ConfigError(f"{origin}: more cells than columns; put a cell with a comma in quotes")
    cells = dict.fromkeys(COLUMNS, "") | dict(zip(header, row.cells, strict=False))
    if not cells["recording"]:
        raise ConfigError(f"{origin}: no recording")
    if cells["recording"].startswith(LIVE_SCHEMES):
        raise SourceError(f"{origin}: a batch takes recordings, not live sources")

    def beside(name: str) -> str:
        """A path of the table, which starts at its folder."""
        return str(table.parent / Path(cells[name]).expanduser()) if cells[name] else ""

    recording = Path(beside("recording"))
    return Flight(
        recording,
        _plain(cells["name"] or Path(os.path.abspath(recording)).name),
        cells["camera"] if cells["camera"] in PRESETS else beside("camera"),
        beside("telemetry"),
        _words(cells["topic"]),
        beside("truth"),
        _words(cells["settings"]),
        origin,
    )


def _words(cell: str) -> tuple[str, ...]:
    """Several values of one cell, between blanks or semicolons."""
    return tuple(word for word in re.split(r"[;\s]+", cell) if word)


def _plain(name: str) -> str:
    """A name that is a folder's on every system, and no path."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._")[:_MAX_NAME] or "flight"


def _told_apart(flights: Sequence[Flight]) -> list[Flight]:
    taken: set[str] = set()
    named = []
    for flight in flights:
        name, number = flight.name, 1
        while name.lower() in taken:  # some file systems ignore case
            number += 1
            name = f"{flight.name}-{number}"
        taken.add(name.lower())
        named.append(replace(flight, name=name))
    return named
