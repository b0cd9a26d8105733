"""Record of a planner's inputs and decisions: one JSON line per limits, skill, contact, state and decision.

A state is written before the planner processes it, so that the record shows the input of a hang or crash. A truncated
last line is ignored. Numbers are exact, so that a replay decides the same.
"""

import base64
import importlib
import json
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import EdgeSlamError, OutputError, SourceError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.navigation.drone_state import Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.skills.skill import Skill

PLAN = "plan.jsonl"
_HEAD = {"format": "edgeslam planner", "version": 3}
_MAX_LINE, _MAX_ARRAY = 1 << 24, 1 << 26
"""Maximum number of bytes of a line and of an array in it; the largest view has 2 MB."""
_MAX_RATIO, _MAX_UNPACKED = 50, 1 << 28
"""All arrays of a record may have so many times the bytes of its file, and so many bytes more; real ones have ten."""
_OURS = ("edgeslam_torch.navigation.", "edgeslam_torch.flying.")
"""Packages whose dataclasses may occur in a record; no other name is imported."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The planner's command for a state, and its phase."""

    command: VelocityCommand
    phase: str


@dataclass(frozen=True, slots=True)
class NewSkill:
    """Start of a skill."""

    skill: Skill


Entry = NavLimits | NewSkill | Contact | DroneState | Decision


class PlanLog:
    """Writes a record; every call appends one line.

    Args:
        path: File; an existing one is replaced.
        limits: Limits of the flight.

    Raises:
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path, limits: NavLimits) -> None:
        self._file = Appender(path, json.dumps(_HEAD) + "\n")
        self.add(limits)

    def add(self, entry: Entry) -> None:
        """Append an entry.

        Raises:
            OSError: If the disk is full; the file stays valid up to here.
            OutputError: If a skill holds a value that cannot be serialised.
        """
        self._file.write(json.dumps(_encoded(entry)) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_plan(path: Path) -> Iterator[Entry]:
    """Entries in order, the flight's limits first. A truncated last line is ignored.

    Raises:
        SourceError: If the file is missing, of another format, or damaged before its end.
    """
    try:
        with open_plain(path) as file:
            room = _Room(_MAX_RATIO * path.stat().st_size + _MAX_UNPACKED)
            lines = iter(lambda: file.readline(_MAX_LINE), b"")
            head = _parsed(next(lines, b""), path, 1)
            if not isinstance(head, dict) or head.get("format") != _HEAD["format"]:
                raise SourceError(f"{path}: not a planner's record")
            if head.get("version") != _HEAD["version"]:
                raise SourceError(f"{path}: version {head.get('version')} is not supported, only {_HEAD['version']}")
            for number, line in enumerate(lines, 2):
                if not line.endswith(b"\n"):
                    return  # truncated by a crash
                yield _entry(_parsed(line, path, number), path, number, room)
    except FileNotFoundError as error:
        raise SourceError(f"{path}: not found; 'edgeslam fly ... --fly --record DIR' writes it") from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from error


def _parsed(line: bytes, path: Path, number: int) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{path}: line {number} is damaged or not a planner's record") from error


class _Room:
    """Bytes that arrays of a record may still take."""

    def __init__(self, size: int) -> None:
        self._left = size

    def take(self, size: int) -> None:
        self._left -= size
        if not 0 <= size <= min(_MAX_ARRAY, self._left):
            raise ValueError(f"an array of {size} bytes")


def _entry(value: Any, path: Path, number: int, room: _Room) -> Entry:
    try:
        entry = _decoded(value, room)
    except EdgeSlamError as error:
        raise SourceError(f"{path}: line {number}: {error}") from error
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError, MemoryError, zlib.error) as error:
        raise SourceError(f"{path}: line {number} is damaged ({error})") from error
    if not isinstance(entry, Entry):
        raise SourceError(f"{path}: line {number} is not an entry of a planner's record")
    return entry


def _encoded(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        # Internal state starts with an underscore or is left out of comparisons; a replay rebuilds it.
        recorded = [f.name for f in fields(value) if f.init and f.compare and f.name[0] != "_"]
        kept = {name: _encoded(getattr(value, name)) for name in recorded}
        return {"kind": f"{type(value).__module__}:{type(value).__name__}", **kept}
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        data = base64.b64encode(zlib.compress(np.ascontiguousarray(value).tobytes(), 1)).decode("ascii")
        return {"dtype": value.dtype.str, "shape": value.shape, "zlib": data}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return [_encoded(x) for x in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise OutputError(f"a flight's record cannot hold a {type(value).__name__}")


def _decoded(value: Any, room: _Room) -> Any:
    if isinstance(value, list):
        return [_decoded(x, room) for x in value]
    if not isinstance(value, dict):
        return value
    if "zlib" in value:
        kind, shape = np.dtype(value["dtype"]), [int(length) for length in value["shape"]]
        size = math.prod(shape) * kind.itemsize
        if kind.kind not in "fiub":
            raise ValueError(f"an array of {kind}")
        room.take(size)
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(base64.b64decode(value["zlib"]), size + 1)  # bounded: no decompression bombs
        return np.frombuffer(data, kind).reshape(shape).copy()
    return _kind(value["kind"])(**{name: _decoded(x, room) for name, x in value.items() if name != "kind"})


def _kind(name: str) -> Any:
    """The dataclass of this name, from `_OURS` only."""
    module, _, word = name.partition(":")
    if module.startswith(_OURS):
        try:
            found = getattr(importlib.import_module(module), word, None)
        except ImportError:
            found = None
        if isinstance(found, type) and is_dataclass(found):
            return found
    raise SourceError(f"{name} is unknown to this version")
