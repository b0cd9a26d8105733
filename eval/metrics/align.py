"""Least-squares alignment of two point sets (none, SE(3), Sim(3)), and of two clocks by the shapes of two trajectories.

S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.types import FloatArray


class AlignmentKind(StrEnum):
    """Degrees of freedom given to the estimate before it is compared."""

    NONE = "none"
    SE3 = "se3"
    SIM3 = "sim3"


@dataclass(frozen=True, slots=True)
class Alignment:
    """``p_truth = scale * R @ p_estimate + t``."""

    scale: float = 1.0
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    """``(3, 3)``."""
    t: FloatArray = field(default_factory=lambda: np.zeros(3))
    """``(3,)`` [m]."""
    kind: AlignmentKind = AlignmentKind.NONE
    degenerate: bool = False
    """The positions lie on a line or a point, so that the rotation is not determined."""

    def points(self, p: FloatArray) -> FloatArray:
        """Estimated points ``(N, 3)`` in the truth's frame."""
        return self.scale * p @ self.R.T + self.t

    def poses(self, T: FloatArray) -> FloatArray:
        """Estimated poses ``(N, 4, 4)`` in the truth's frame; rotations stay rotations."""
        out = T.copy()
        out[:, :3, :3] = self.R @ T[:, :3, :3]
        out[:, :3, 3] = self.points(T[:, :3, 3])
        return out


def umeyama(estimate: FloatArray, truth: FloatArray, kind: AlignmentKind | str = AlignmentKind.SIM3) -> Alignment:
    """Alignment of ``estimate`` ``(N, 3)`` to ``truth`` ``(N, 3)`` with the least squared distance.

    Raises:
        EvaluationError: With fewer than two points, or an estimate that never moves (no scale).

    Example:
        >>> p = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> umeyama(p, 2 * p + 1).scale
        2.0
    """
    kind = AlignmentKind(kind)
    if kind is AlignmentKind.NONE:
        return Alignment()
    if len(estimate) < 2:
        raise EvaluationError(f"{len(estimate)} matched pose(s): an alignment needs at least 2, better 3 off a line")
    mean_e, mean_t = estimate.mean(axis=0), truth.mean(axis=0)
    centred_e, centred_t = estimate - mean_e, truth - mean_t
    variance_e = float(np.mean(np.sum(centred_e**2, axis=1)))
    if variance_e < 1e-18:
        raise EvaluationError("the estimated trajectory never moves: nothing to align")
    U, d, Vt = np.linalg.svd(centred_t.T @ centred_e / len(estimate))  # eq. 38
    sign = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        sign[2] = -1.0  # eq. 43: no reflection
    R = U @ np.diag(sign) @ Vt
    scale = float(np.sum(d * sign) / variance_e) if kind is AlignmentKind.SIM3 else 1.0
    return Alignment(scale, R, mean_t - scale * R @ mean_e, kind, degenerate=bool(d[1] <= 1e-9 * max(d[0], 1e-300)))


def rms(vectors: FloatArray) -> float:
    """Root mean square length of ``(N, 3)``."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def travelled(p: FloatArray) -> FloatArray:
    """Way ``(N,)`` from the first of the positions ``(N, D)`` along them."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])


def misfit(estimate: FloatArray, truth: FloatArray) -> float:
    """Sim(3) ATE of positions ``(N, 3)`` over what a fixed position would score; infinite when it is not defined."""
    still = rms(truth - truth.mean(axis=0)) if len(truth) else 0.0
    try:
        return rms(umeyama(estimate, truth).points(estimate) - truth) / still if still > 0 else float("inf")
    except EvaluationError:
        return float("inf")


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
