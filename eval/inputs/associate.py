"""Two trajectories on one clock in seconds, their association by time, and common mistakes in time stamps."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.trajectory_files import ROWS, Trajectory
from edgeslam_torch.types import FloatArray, IntArray

DEFAULT_MAX_DT_S = 0.02
"""Largest time between matched poses; the default of the TUM tools and evo for 30 Hz video."""

SINCE_1970_S = 1e6
"""Stamps above this [s] count from 1970, those below from the start of something."""

_MIN_SHARE = 0.1
"""Two files of one recording pair at least this share of the poses that they could."""


def nearest(stamps_s: FloatArray, queries_s: FloatArray) -> IntArray:
    """Index of the stamp nearest to each query; ``stamps_s`` must increase; ties go to the earlier one."""
    right = np.clip(np.searchsorted(stamps_s, queries_s), 1, max(len(stamps_s) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps_s) - 1)
    closer_left = np.abs(queries_s - stamps_s[left]) <= np.abs(stamps_s[right] - queries_s)
    return np.where(closer_left, left, right)


def match(truth_s: FloatArray, estimate_s: FloatArray, max_dt_s: float = DEFAULT_MAX_DT_S) -> tuple[IntArray, IntArray]:
    """Indices ``(truth, estimate)`` of poses within ``max_dt_s``: each pose of the shorter list with its nearest.

    The same rule as evo's, so that figures agree.
    """
    if len(estimate_s) > len(truth_s):
        j, i = match(estimate_s, truth_s, max_dt_s)
        return i, j
    i = nearest(truth_s, estimate_s)
    ok = np.abs(truth_s[i] - estimate_s) <= max_dt_s
    return i[ok], np.flatnonzero(ok)


def associate(
    truth_s: FloatArray, estimate_s: FloatArray, max_dt_s: float = DEFAULT_MAX_DT_S
) -> tuple[IntArray, IntArray]:
    """`match`, of two trajectories of one recording.

    Raises:
        EvaluationError: If hardly anything matches; the message names the likely mistake.
    """
    i, j = match(truth_s, estimate_s, max_dt_s)
    if len(i) == 0:
        raise EvaluationError(_why_nothing_matches(truth_s, estimate_s, max_dt_s))
    possible = possible_pairs(truth_s, estimate_s)
    if len(i) < _MIN_SHARE * possible:
        gap = _typical_distance_s(truth_s, estimate_s)
        raise EvaluationError(
            f"only {len(i)} of {possible} poses have a match within {max_dt_s:g} s, typically {gap:.3f} s apart: "
            "another unit of time, an --offset, or a larger --max-dt"
        )
    return i, j


def possible_pairs(truth_s: FloatArray, estimate_s: FloatArray) -> int:
    """Poses of the list that has fewer in the time that both have."""
    first, last = max(truth_s[0], estimate_s[0]), min(truth_s[-1], estimate_s[-1])
    return min(int(((t >= first) & (t <= last)).sum()) for t in (truth_s, estimate_s))


def overlap_s(a: FloatArray, b: FloatArray) -> float:
    """Time [s] that two lists of stamps have in common; negative between lists that do not meet."""
    return float(min(a[-1], b[-1]) - max(a[0], b[0]))


def _typical_distance_s(truth_s: FloatArray, estimate_s: FloatArray) -> float:
    return float(np.median(np.abs(truth_s[nearest(truth_s, estimate_s)] - estimate_s)))


def _why_nothing_matches(truth_s: FloatArray, estimate_s: FloatArray, max_dt_s: float) -> str:
    t0, t1, e0, e1 = truth_s[0], truth_s[-1], estimate_s[0], estimate_s[-1]
    spans = f"ground truth {t0:.3f}..{t1:.3f} s, estimate {e0:.3f}..{e1:.3f} s"
    if overlap_s(truth_s, estimate_s) >= 0:
        gap = _typical_distance_s(truth_s, estimate_s)
        return (
            f"no poses within {max_dt_s:g} s of each other, typically {gap:.3f} s apart; try --max-dt {2 * gap:.2g} "
            f"({spans})"
        )
    if min(t0, e0) < SINCE_1970_S < max(t0, e0):
        return (
            f"one clock starts near 0 and the other counts from 1970 ({spans}); if they start together, use "
            f"--offset {t0 - e0:.6f}"
        )
    if abs(t0 - e0) > 86400.0:
        return f"the stamps are days apart: the files are of different sequences ({spans})"
    return (
        f"the two do not overlap in time: another sequence, or a constant offset of about {t0 - e0:.3f} s "
        f"(--offset) ({spans})"
    )


_FEW = 10
"""Number of poses too small to infer the length of a recording."""

_MAX_RATIO = 200.0
"""Two files of one recording last as long as each other within this factor; units differ by 1000."""

_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


def on_one_clock(truth: Trajectory, estimate: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Both trajectories with comparable stamps in seconds, each with a note of what was done to it.

    Poses without stamps (KITTI rows, 7-Scenes frames) get those of the other file where that has as many. Stamps that
    are milli-, micro- or nanoseconds beside the other file's seconds are converted. Applied again, it changes nothing.

    Raises:
        EvaluationError: If rows without times face another number of stamped poses.
    """
    truth, estimate = _stamped_like(truth, estimate), _stamped_like(estimate, truth)
    factor, unit = _unit_factor(truth.stamps_s, estimate.stamps_s)
    if factor < 1.0:
        return truth, _converted(estimate, factor, unit)
    if factor > 1.0:
        return _converted(truth, 1.0 / factor, unit), estimate
    return truth, estimate


def in_order(mine: Trajectory, stamps_s: FloatArray, whose: str) -> Trajectory:
    """The poses of a file without stamps under ``stamps_s`` that are as many; else as they are."""
    if mine.stamped or len(mine) != len(stamps_s):
        return mine
    note = f"no stamps in the file: its poses are taken for {whose}, in order"
    return replace(mine, stamps_s=stamps_s, numbered="", notes=(note,))


def _stamped_like(mine: Trajectory, other: Trajectory) -> Trajectory:
    if not other.stamped:
        return mine
    mine = in_order(mine, other.stamps_s, f"those of {other.source}")
    if mine.numbered == ROWS:
        raise EvaluationError(
            f"{mine.source}: {len(mine)} rows without times, and {len(other)} poses in {other.source}; put a times.txt "
            "with a time for every row beside it"
        )
    return mine


def _converted(trajectory: Trajectory, factor: float, unit: str) -> Trajectory:
    note = f"the stamps are {unit}: converted to seconds"
    return replace(trajectory, stamps_s=trajectory.stamps_s * factor, notes=(*trajectory.notes, note))


def _unit_factor(truth_s: FloatArray, estimate_s: FloatArray) -> tuple[float, str]:
    """Factor that brings the estimated stamps to the truth's unit, when it is a power of a thousand, and the unit.

    Clocks that start at 0 overlap in any unit, so stamps that do overlap are still suspected when one list lasts
    more than 200 times as long as the other, unless both count from 1970 (they overlap by no accident then) or one
    holds a handful of poses at a like rate. When no unit makes them overlap, the two clocks start at different
    times, and the lists' durations still determine the unit.
    """
    span_t, span_e = truth_s[-1] - truth_s[0], estimate_s[-1] - estimate_s[0]
    ratio = span_e / span_t if span_t > 0 and span_e > 0 else 1.0
    if overlap_s(truth_s, estimate_s) >= 0:
        few = (
            min(len(truth_s), len(estimate_s)) < _FEW and 1 / _MAX_RATIO < _gap(estimate_s) / _gap(truth_s) < _MAX_RATIO
        )
        if 1 / _MAX_RATIO < ratio < _MAX_RATIO or few or min(truth_s[0], estimate_s[0]) > SINCE_1970_S:
            return 1.0, ""
    candidates = {f: name for name, unit in _UNITS.items() for f in (unit, 1.0 / unit)}
    for factor, name in candidates.items():
        similar = 1 / _MAX_RATIO < ratio * factor < _MAX_RATIO
        if similar and overlap_s(truth_s, estimate_s * factor) > 0.1 * min(span_t, span_e * factor):
            return factor, name
    likeliest = min(candidates, key=lambda factor: abs(np.log(ratio * factor)))
    if not 1 / _MAX_RATIO < ratio < _MAX_RATIO and 1 / 30 < ratio * likeliest < 30:
        return likeliest, candidates[likeliest]
    return 1.0, ""


def _gap(stamps_s: FloatArray) -> float:
    """Typical time from one stamp to the next [s]."""
    return float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 1.0
