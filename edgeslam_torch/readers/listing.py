"""Lists of images with stamps, and their defects."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.types import FloatArray, IntArray


class Problem(NamedTuple):
    """A defect of a source: what was skipped and why, or a remark."""

    file: str
    reason: str
    frames: int = 1
    """Skipped frames; 0 for a remark."""


@dataclass(frozen=True, slots=True)
class ImageEntry:
    """One listed image."""

    index: int
    """Position in the source, from 0."""
    stamp_s: float
    path: Path


def seconds_from(stamps: Sequence[float]) -> tuple[FloatArray, str]:
    """Stamps in seconds and their original unit, inferred from their magnitude.

    Unix time is about 2e9 s now; the ranges of the units do not overlap before the year 5138.

    Example:
        >>> seconds_from([1403636579763555584.0])[1]
        'ns'
    """
    array = np.asarray(stamps, dtype=np.float64)
    size = float(np.median(np.abs(array))) if len(array) else 0.0
    for unit, limit, factor in (("ns", 1e17, 1e-9), ("us", 1e14, 1e-6), ("ms", 1e11, 1e-3)):
        if size >= limit:
            return array * factor, unit
    return array, "s"


def read_list(path: Path) -> tuple[list[tuple[float, str]], list[Problem]]:
    """Rows ``stamp path`` of a list; other lines become problems.

    Raises:
        SourceError: If the file is not text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise SourceError(f"{path}: cannot be read as a text list of images ({error})") from error
    rows: list[tuple[float, str]] = []
    problems: list[Problem] = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        stamp, _, name = line.replace(",", " ", 1).partition(" ")
        value = _finite(stamp)
        if value is None or not name.strip():
            problems.append(Problem(f"{path}:{number}", f"not 'stamp path': {line[:60]!r}"))
            continue
        rows.append((value, name.strip()))
    return rows, problems


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def in_order(entries: Sequence[ImageEntry], name: str) -> tuple[list[ImageEntry], list[Problem]]:
    """The entries with strictly increasing stamps, and a problem for each skipped one.

    A wild stamp costs one image: the longest increasing subsequence is kept. A list that is not in
    time order at all (less than nine tenths would stay) is sorted instead, without repeated stamps; a remark says so.

    Args:
        entries: As listed.
        name: File or folder that lists them, for messages.
    """
    stamps = np.array([entry.stamp_s for entry in entries])
    problems: list[Problem] = []
    keep = _longest_increasing(stamps)
    if len(keep) < 0.9 * len(entries) and np.any(np.diff(stamps) < 0):
        falls = bool(np.all(np.diff(stamps) <= 0))
        order = "from the last to the first" if falls else "in no order of their stamps"
        problems.append(Problem(name, f"lists images {order}; they are used sorted by stamp", frames=0))
        entries = sorted(entries, key=lambda entry: entry.stamp_s)
        stamps = np.array([entry.stamp_s for entry in entries])
        keep = np.flatnonzero(np.diff(stamps, prepend=-np.inf) > 0)
    kept = set(keep.tolist())
    kept_stamps = set(stamps[keep].tolist())
    for i, entry in enumerate(entries):
        if i not in kept:
            word = "is a repetition" if entry.stamp_s in kept_stamps else "is out of order"
            problems.append(Problem(str(entry.path), f"stamp {entry.stamp_s:.6f} {word}; image left out"))
    return [entries[i] for i in keep], problems


def _longest_increasing(values: FloatArray) -> IntArray:
    """Indices of a longest strictly increasing subsequence (patience sorting)."""
    tails: list[float] = []
    tail_index: list[int] = []
    previous = np.full(len(values), -1)
    for i, value in enumerate(values.tolist()):
        at = bisect_left(tails, value)
        previous[i] = tail_index[at - 1] if at else -1
        if at == len(tails):
            tails.append(value)
            tail_index.append(i)
        else:
            tails[at], tail_index[at] = value, i
    chain = []
    i = tail_index[-1] if tail_index else -1
    while i >= 0:
        chain.append(i)
        i = int(previous[i])
    return np.array(chain[::-1], dtype=np.int64)
