"""Lists of images with stamps, and their defects."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.tables import number, read_table
from edgeslam_torch.files.time_units import MAX_STAMP_S, NAMES, UNKNOWN, is_date, seconds_of
from edgeslam_torch.types import FloatArray, IntArray

_MAX_BYTES = 64 << 20
"""Maximum size of a list; a million images take 60 MB."""


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


def read_list(path: Path) -> tuple[list[tuple[float, str]], list[Problem]]:
    """Rows ``stamp path`` of a list; other lines become problems.

    Raises:
        SourceError: If the file is not text.
    """
    rows: list[tuple[float, str]] = []
    problems: list[Problem] = []
    table = read_table(path, SourceError, columns=2, max_bytes=_MAX_BYTES)
    if table.header and not table.rows:
        problems.append(Problem(f"{path}:1", f"not 'stamp path': {' '.join(table.header)[:60]!r}"))
    for row in table.rows:
        value = number(row.cells[0])
        if value is None or not math.isfinite(value) or len(row.cells) < 2 or not row.cells[1]:
            problems.append(Problem(f"{path}:{row.line}", f"not 'stamp path': {' '.join(row.cells)[:60]!r}"))
            continue
        name = row.cells[1]
        rows.append((value, name if "/" in name else name.replace("\\", "/")))  # Windows' separators
    return rows, problems


def nothing_listed(path: Path, line: str, problems: Sequence[Problem]) -> SourceError:
    """Error of a list without a usable image; ``line`` says how one looks."""
    first = f" ({problems[0].file}: {problems[0].reason})" if problems else ""
    return SourceError(f"{path}: lists no image; a line is {line}{first}")


def read_times(path: Path) -> FloatArray:
    """Stamps of a file with one a line.

    Raises:
        SourceError: If it is not such a file.
    """
    return read_table(path, SourceError, max_bytes=_MAX_BYTES).numbers([0])[:, 0]


def entries_in_time(
    stamps: ArrayLike, paths: Sequence[Path], name: str, unit: str = "s"
) -> tuple[list[ImageEntry], list[Problem]]:
    """Images in time order, as `in_order`, from stamps in any unit.

    Args:
        stamps: One an image.
        paths: The images.
        name: File or folder that lists them, for messages.
        unit: Unit that the stamps should have; another one is a remark.

    Raises:
        SourceError: As `in_order`.
    """
    seconds, remarks = image_times(stamps, name, unit)
    entries = [ImageEntry(i, stamp, path) for i, (stamp, path) in enumerate(zip(seconds.tolist(), paths, strict=True))]
    kept, problems = in_order(entries, name)
    return kept, [*remarks, *problems]


def image_times(stamps: ArrayLike, name: str, unit: str = "s") -> tuple[FloatArray, list[Problem]]:
    """Stamps in seconds, and a remark if they are in another unit than ``unit``, plausible in none, or frame numbers.

    Dates of our time are in no doubt and need no remark. ``name`` is for messages.
    """
    seconds, found = seconds_of(stamps)
    gaps = np.abs(np.diff(seconds))
    counted = found == "s" and len(gaps) > 1 and gaps[0] >= 1.0 and bool(np.all(gaps == gaps[0]))
    if len(seconds) < 2 or (found == unit and not counted) or (found != UNKNOWN and is_date(seconds)):
        return seconds, []
    gap = np.median(gaps)
    if counted:
        reason = f"stamps are exactly {gap:g} s apart: frame numbers? They are taken as seconds"
    elif found == UNKNOWN:
        reason = f"stamps are {gap:.3g} apart, which is the time between two images in no unit; taken as seconds"
    else:
        reason = f"stamps are read as {NAMES[found]}: the images are {gap:.3g} s apart"
    return seconds, [Problem(name, reason, frames=0)]


def in_order(entries: Sequence[ImageEntry], name: str) -> tuple[list[ImageEntry], list[Problem]]:
    """The entries with strictly increasing stamps, and a problem for each skipped one.

    A wild stamp costs one image: the longest increasing subsequence is kept. A list that is not in
    time order at all (less than nine tenths would stay) is sorted instead, without repeated stamps; a remark says so.

    Args:
        entries: As listed.
        name: File or folder that lists them, for messages.

    Raises:
        SourceError: If no stamp is a time, or most images have the stamp of another one.
    """
    if entries and not any(abs(entry.stamp_s) <= MAX_STAMP_S for entry in entries):
        raise SourceError(f"{name}: none of its stamps is a time, such as {entries[0].stamp_s:g} s")
    problems = [
        Problem(str(entry.path), f"stamp {entry.stamp_s:g} is not a time; image left out")
        for entry in entries
        if not abs(entry.stamp_s) <= MAX_STAMP_S
    ]
    entries = [entry for entry in entries if abs(entry.stamp_s) <= MAX_STAMP_S]
    stamps = np.array([entry.stamp_s for entry in entries])
    different = len(np.unique(stamps))
    if 2 * different < len(entries):
        raise SourceError(
            f"{name}: {len(entries)} images have only {different} different stamps, such as {stamps[0]:.6f}; each "
            "image needs its own (were their decimals cut off?)"
        )
    keep = longest_increasing(stamps)
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


def longest_increasing(values: FloatArray) -> IntArray:
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
