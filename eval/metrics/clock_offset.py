"""The constant time offset between two clocks, found from the shapes of the two trajectories."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import misfit, rms, umeyama

NEAR_S = 10.0
"""Offsets tried when the clocks overlap."""
_MAX_POSES, _MAX_TRIALS, _STEP_S, _FINEST_S = 200, 2000, 0.1, 2e-2
_MIN_SHARE, _MIN_POSES = 0.4, 10
"""Share of the estimate, and number of poses, that must lie within the truth's time."""


@dataclass(frozen=True, slots=True)
class Offset:
    """A constant offset between two clocks and how well the trajectories fit with it."""

    shift_s: float
    """Added to the estimate's stamps."""
    ate_m: float
    """Sim(3) ATE, infinite when nothing overlaps."""
    share: float
    """That ATE over what a fixed position would score in the same time: 1 is no fit at all."""


def best_offset(truth: Trajectory, estimate: Trajectory) -> Offset:
    """The offset within `NEAR_S` to either side under which the shapes fit best."""
    reach = min(NEAR_S, 0.5 * float(np.ptp(estimate.stamps_s)))
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
        best = min([best, *(_fit(truth, few, float(shift)) for shift in trials)], key=lambda offset: offset.share)
        if step < _FINEST_S or not np.isfinite(best.share):
            return best
        trials = np.arange(best.shift_s - step, best.shift_s + step, step / 10)
        step /= 10


def _fit(truth: Trajectory, estimate: Trajectory, shift: float) -> Offset:
    stamps = estimate.stamps_s + shift
    inside = (stamps >= truth.stamps_s[0]) & (stamps <= truth.stamps_s[-1])
    if inside.sum() < max(_MIN_POSES, _MIN_SHARE * len(stamps)):
        return Offset(shift, float("inf"), float("inf"))
    p = estimate.positions[inside]
    q = np.stack([np.interp(stamps[inside], truth.stamps_s, axis) for axis in truth.positions.T], axis=1)
    share = misfit(p, q)
    error_m = rms(umeyama(p, q).points(p) - q) if np.isfinite(share) else float("inf")
    return Offset(shift, error_m, share)
