"""Two trajectories on one clock in seconds; either file resolves ambiguities of the other."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import SINCE_1970_S, overlap_s
from edgeslam_torch.eval.inputs.trajectory_files import ROWS, Trajectory
from edgeslam_torch.types import FloatArray

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


def _stamped_like(mine: Trajectory, other: Trajectory) -> Trajectory:
    if mine.stamped or not other.stamped:
        return mine
    if len(mine) == len(other):
        note = f"no stamps in the file: its poses are taken for those of {other.source}, in order"
        return replace(mine, stamps_s=other.stamps_s, numbered="", notes=(note,))
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
