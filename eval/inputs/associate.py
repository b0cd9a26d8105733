"""Association of estimated and true poses by time; diagnoses common mistakes in time stamps."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.types import FloatArray, IntArray

DEFAULT_MAX_DT_S = 0.02
"""Largest time between matched poses; the default of the TUM tools and evo for 30 Hz video."""

SINCE_1970_S = 1e6
"""Stamps above this [s] count from 1970, those below from the start of something."""

_MIN_SHARE = 0.1
"""Two files of one recording pair at least this share of the poses that they could."""


@dataclass(frozen=True, slots=True)
class Association:
    """Matched pairs of two lists of stamps."""

    truth: IntArray
    """``(M,)`` indices into the true stamps."""
    estimate: IntArray
    """``(M,)`` indices into the estimated stamps."""
    offset_s: float = 0.0
    """Added to the estimated stamps before matching."""

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
    """Match estimated to true stamps.

    Args:
        truth_s: True stamps ``(N,)`` [s], increasing.
        estimate_s: Estimated stamps ``(M,)`` [s], increasing.
        max_dt_s: Largest time between matched poses [s].
        offset_s: Added to the estimated stamps [s].

    Raises:
        EvaluationError: If hardly anything matches; the message names the likely mistake.
    """
    stamps = estimate_s + offset_s
    i, j = match(truth_s, stamps, max_dt_s)
    if len(i) == 0:
        raise EvaluationError(_why_nothing_matches(truth_s, stamps, max_dt_s))
    possible = possible_pairs(truth_s, stamps)
    if len(i) < _MIN_SHARE * possible:
        gap = _typical_distance_s(truth_s, stamps)
        raise EvaluationError(
            f"only {len(i)} of {possible} poses have a match within {max_dt_s:g} s, typically {gap:.3f} s apart: "
            "another unit of time, an --offset, or a larger --max-dt"
        )
    return Association(i, j, offset_s)


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
