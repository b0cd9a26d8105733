"""Association of estimated and true poses by time; detects the usual mistakes of time stamps."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.types import FloatArray, IntArray

DEFAULT_MAX_DT_S = 0.02
"""Largest time between matched poses; the TUM tools' and evo's usual value for 30 Hz video."""

_SINCE_1970_S = 1e6
"""Stamps above this [s] count from 1970, those below from the start of something."""

_FEW = 10
"""Number of poses too small to infer the length of a recording."""

_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


@dataclass(frozen=True, slots=True)
class Association:
    """Matched pairs of two lists of stamps."""

    truth: IntArray
    """``(M,)`` indices into the true stamps."""
    estimate: IntArray
    """``(M,)`` indices into the estimated stamps."""
    offset_s: float = 0.0
    """Added to the estimated stamps before matching."""
    factor: float = 1.0
    """The estimated stamps were multiplied by this first (1e-9 when the file holds nanoseconds)."""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.truth)


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
    if len(estimate_s) <= len(truth_s):
        other = nearest(truth_s, estimate_s)
        ok = np.abs(truth_s[other] - estimate_s) <= max_dt_s
        return other[ok], np.flatnonzero(ok)
    other = nearest(estimate_s, truth_s)
    ok = np.abs(estimate_s[other] - truth_s) <= max_dt_s
    return np.flatnonzero(ok), other[ok]


def associate(
    truth_s: FloatArray,
    estimate_s: FloatArray,
    max_dt_s: float = DEFAULT_MAX_DT_S,
    offset_s: float = 0.0,
) -> Association:
    """Match estimated to true stamps, recognising milliseconds, microseconds and nanoseconds.

    Args:
        truth_s: True stamps ``(N,)`` [s], increasing.
        estimate_s: Estimated stamps ``(M,)``, increasing.
        max_dt_s: Largest time between matched poses [s].
        offset_s: Added to the estimated stamps [s].

    Raises:
        EvaluationError: If nothing matches; the message says which of the usual mistakes it looks like.
    """
    factor, notes = unit_factor(truth_s, estimate_s)
    stamps = estimate_s * factor + offset_s
    i, j = match(truth_s, stamps, max_dt_s)
    if len(i) == 0:
        reasons = [_why_nothing_matches(truth_s, stamps, max_dt_s), *notes]
        raise EvaluationError("; ".join(reasons))
    return Association(i, j, offset_s, factor, tuple(notes))


def unit_factor(truth_s: FloatArray, estimate_s: FloatArray) -> tuple[float, list[str]]:
    """Factor that brings the estimated stamps to the truth's unit, when it is a power of a thousand, and a note of it.

    Clocks that start at 0 overlap in any unit, so stamps that do overlap are still suspected when one list lasts
    more than 200 times as long as the other, unless both count from 1970 (they overlap by no accident then) or one
    holds a handful of poses at a like rate. When no unit makes them overlap, the two clocks start at different
    times, and how long the lists last still tells the unit.
    """
    span_t, span_e = truth_s[-1] - truth_s[0], estimate_s[-1] - estimate_s[0]
    ratio = span_e / span_t if span_t > 0 and span_e > 0 else 1.0
    if _overlap(truth_s, estimate_s) >= 0:
        few = min(len(truth_s), len(estimate_s)) < _FEW and 1 / 200 < _gap(estimate_s) / _gap(truth_s) < 200
        if 1 / 200 < ratio < 200 or few or min(truth_s[0], estimate_s[0]) > _SINCE_1970_S:
            return 1.0, []
    candidates = {
        factor: f"{whose} stamps are {name}, the other file's seconds: converted"
        for name, per_second in _UNITS.items()
        for factor, whose in ((1.0 / per_second, "the estimate's"), (per_second, "the ground truth's"))
    }
    for factor, note in candidates.items():
        alike = 1 / 200 < ratio * factor < 200
        if alike and _overlap(truth_s, estimate_s * factor) > 0.1 * min(span_t, span_e * factor):
            return factor, [note]
    likeliest = min(candidates, key=lambda factor: abs(np.log(ratio * factor)))
    if not 1 / 200 < ratio < 200 and 1 / 30 < ratio * likeliest < 30:
        return likeliest, [candidates[likeliest]]
    return 1.0, []


def _overlap(a: FloatArray, b: FloatArray) -> float:
    return float(min(a[-1], b[-1]) - max(a[0], b[0]))


def _gap(stamps_s: FloatArray) -> float:
    """Typical time from one stamp to the next [s]."""
    return float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 1.0


def _why_nothing_matches(truth_s: FloatArray, estimate_s: FloatArray, max_dt_s: float) -> str:
    t0, t1, e0, e1 = truth_s[0], truth_s[-1], estimate_s[0], estimate_s[-1]
    spans = f"ground truth {t0:.3f}..{t1:.3f} s, estimate {e0:.3f}..{e1:.3f} s"
    if _overlap(truth_s, estimate_s) >= 0:
        gap = float(np.median(np.abs(truth_s[nearest(truth_s, estimate_s)] - estimate_s)))
        return (
            f"no poses within {max_dt_s:g} s of each other, typically {gap:.3f} s apart; try --max-dt {2 * gap:.2g} "
            f"({spans})"
        )
    if min(t0, e0) < _SINCE_1970_S < max(t0, e0):
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
