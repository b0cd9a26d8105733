"""The constant time offset between two clocks, found from the shapes of the two trajectories."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import umeyama

NEAR_S = 10.0
"""Offsets tried when the clocks overlap."""

_MAX_POSES = 200
_MAX_TRIALS = 2000
_STEP_S = 0.1
_MIN_SHARE = 0.4
"""Share of the estimate that must lie within the truth's time."""


@dataclass(frozen=True, slots=True)
class Offset:
    """A constant offset between two clocks and how well the trajectories fit with it."""

    shift_s: float
    """Added to the estimate's stamps."""
    ate_m: float
    """Sim(3) ATE, infinite when nothing overlaps."""
    share: float
    """That ATE over what a fixed position would score in the same time: 1 is no fit at all."""


def best_offset(truth: Trajectory, estimate: Trajectory, reach_s: float = NEAR_S) -> Offset:
    """The offset within ``±reach_s`` under which the shapes fit best."""
    reach = min(reach_s, 0.5 * float(np.ptp(estimate.stamps_s)))
    return _search(truth, estimate, -reach, reach)


def any_offset(truth: Trajectory, estimate: Trajectory) -> Offset:
    """The same over all offsets with overlap, for unrelated clocks."""
    span = float(np.ptp(estimate.stamps_s))
    first = float(truth.stamps_s[0] - estimate.stamps_s[-1]) + _MIN_SHARE * span
    last = float(truth.stamps_s[-1] - estimate.stamps_s[0]) - _MIN_SHARE * span
    return _search(truth, estimate, first, last)


def _search(truth: Trajectory, estimate: Trajectory, first: float, last: float) -> Offset:
    few = estimate.take(slice(None, None, max(1, -(-len(estimate) // _MAX_POSES))))
    step = max(_STEP_S, (last - first) / _MAX_TRIALS)
    trials = np.arange(first, last + step / 2, step)
    best = Offset(0.0, float("inf"), float("inf"))
    while True:
        for shift in trials:
            found = _fit(truth, few, float(shift))
            best = found if found.share < best.share else best
        if step < 2e-2 or not np.isfinite(best.share):
            return best
        trials = np.arange(best.shift_s - step, best.shift_s + step, step / 10)
        step /= 10


def _fit(truth: Trajectory, estimate: Trajectory, shift: float) -> Offset:
    stamps = estimate.stamps_s + shift
    inside = (stamps >= truth.stamps_s[0]) & (stamps <= truth.stamps_s[-1])
    if inside.sum() < max(10, _MIN_SHARE * len(stamps)):
        return Offset(shift, float("inf"), float("inf"))
    p = estimate.positions[inside]
    q = np.stack([np.interp(stamps[inside], truth.stamps_s, axis) for axis in truth.positions.T], axis=1)
    still = float(np.sqrt(np.mean(np.sum((q - q.mean(axis=0)) ** 2, axis=1))))
    try:
        error = float(np.sqrt(np.mean(np.sum((umeyama(p, q).points(p) - q) ** 2, axis=1))))
    except EvaluationError:
        return Offset(shift, float("inf"), float("inf"))
    return Offset(shift, error, error / still if still > 0 else float("inf"))
