"""Unit of time stamps: files seldom say whether they count seconds, milliseconds, microseconds or nanoseconds."""

import numpy as np
from numpy.typing import ArrayLike

from edgeslam_torch.types import FloatArray

SECONDS_PER_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
PLAUSIBLE_GAPS_S = (1e-3, 10.0)
"""Time from one image, pose or message to the next: a thousand a second to six a minute."""
_USUAL_GAP_S = 1 / 30
UNKNOWN = "?"
"""Unit of stamps that are plausible in none."""
MAX_STAMP_S = 1e11
"""Larger ones are no time [s]: the year 5138."""
_UNIX_S = (9e8, 4e9)
"""Seconds since 1970 of any recording: 1998 to 2096."""


def is_date(seconds: ArrayLike) -> bool:
    """Whether most of these seconds [s] count from 1970 to a date of our time."""
    return bool(_UNIX_S[0] <= np.median(np.asarray(seconds)) <= _UNIX_S[1])


def seconds_of(stamps: ArrayLike, gaps_s: tuple[float, float] = PLAUSIBLE_GAPS_S) -> tuple[FloatArray, str]:
    """Stamps in seconds, and the unit they are in: ``s``, ``ms``, ``us``, ``ns`` or `UNKNOWN`.

    The unit in which the stamps are a date of our time and the median gap between them is plausible; else seconds if
    the gap is plausible in them; else the unit in which it is, and nearest to a video's. Without a gap (a single
    stamp), the date alone decides. Of an unknown unit, stamps are returned as they are.

    Args:
        stamps: ``(N,)`` in any order.
        gaps_s: Shortest and longest plausible gap [s].

    Example:
        >>> seconds_of([1403636579763555584, 1403636579813555456])[1], seconds_of([0, 33, 67, 100])[1]
        ('ns', 'ms')
    """
    array = np.asarray(stamps, dtype=np.float64)
    finite = np.sort(array[np.isfinite(array)])
    size = float(np.median(finite)) if len(finite) else 0.0
    with np.errstate(over="ignore"):
        gaps = finite[1:] - finite[:-1]
    gaps = gaps[gaps > 0]
    dated = [unit for unit, factor in SECONDS_PER_UNIT.items() if is_date(size * factor)]
    if not len(gaps):
        unit = (dated or ["s"])[0]
        return array * SECONDS_PER_UNIT[unit], unit
    gap = float(np.median(gaps))
    smaller = sorted(("ms", "us", "ns"), key=lambda unit: abs(np.log(gap * SECONDS_PER_UNIT[unit] / _USUAL_GAP_S)))
    possible = (unit for unit in (*dated, "s", *smaller) if size * SECONDS_PER_UNIT[unit] <= MAX_STAMP_S)
    for unit in possible:
        if gaps_s[0] * 0.999 <= gap * SECONDS_PER_UNIT[unit] <= gaps_s[1] * 1.001:  # differences of float64
            return array * SECONDS_PER_UNIT[unit], unit
    return array, UNKNOWN
