"""Robust refinement of one camera pose against fixed points."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.optim.kernels.pose import refined
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray

MIN_POINTS = 6
_MIN_DEPTH = 1e-3
"""Depth of a point [map units] below which it counts as behind the camera."""
_MAX_CONDITION = 1e12
"""Condition number of the scaled normal matrix above which the pose is degenerate."""
_LEAST_STEP = 1e-6
"""Largest tangent component below which a round ends."""


class PoseStatus(StrEnum):
    """Status of a refined pose."""

    OK = "ok"
    FEW_POINTS = "few points"
    DEGENERATE = "degenerate points"
    NOT_CONVERGED = "not converged"
    NOT_FINITE = "not finite"


@dataclass(frozen=True, slots=True)
class PoseConfig:
    """Settings of the refinement."""

    rounds: int = 4
    """Rounds; outliers are selected again after each."""
    robust_rounds: int = 2
    """Rounds with a Huber kernel; later rounds are least squares on the inliers, as in ORB-SLAM."""
    iterations: int = 10
    """Steps per round."""
    chi2: float = CHI2_2DOF_95
    """Squared whitened residual above which a point is an outlier."""
    cost_tolerance: float = 1e-4
    """Relative decrease of the cost below which a round ends."""


@dataclass(frozen=True, slots=True)
class PoseResult:
    """A refined pose."""

    T_c_w: FloatArray
    """``(4, 4)`` world to camera; the start when the status is not OK or NOT_CONVERGED."""
    inliers: NDArray[np.bool_]
    """``(N,)`` inliers."""
    chi2: FloatArray
    """``(N,)`` squared whitened residuals; infinite behind the camera."""
    covariance: FloatArray
    """``(6, 6)`` of a left perturbation, from the inliers; NaN when there is none."""
    iterations: int
    status: PoseStatus


def refine_pose(
    T_c_w: FloatArray,
    p_w: FloatArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    K: tuple[float, float, float, float],
    *,
    slack_px: FloatArray | None = None,
    prior: PosePrior | None = None,
    config: PoseConfig | None = None,
) -> PoseResult:
    """Refine a pose against fixed points by damped, reweighted Gauss-Newton in rounds.

    Args:
        T_c_w: Starting world-to-camera pose ``(4, 4)``.
        p_w: Points ``(N, 3)``.
        uv: Their undistorted pixels ``(N, 2)``.
        inv_sigma: Inverse standard deviations ``(N,)`` [1/px].
        K: fx, fy, cx, cy [px].
        slack_px: Additional standard deviation along one direction ``(N, 2)`` [px], caused by an uncertain depth. The
            covariance is ``I / inv_sigma^2 + slack slack^T``.
        prior: Predicted pose with its information; ``prior.pose`` is not used.
        config: Rounds, thresholds.

    Returns:
        Pose, inliers and status; the pose is finite whenever the start was.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> p = rng.uniform((-1, -1, 2), (1, 1, 4), (50, 3))
        >>> uv = 500 * p[:, :2] / p[:, 2:]
        >>> start = np.eye(4)
        >>> start[:3, 3] = 0.02, 0.0, 0.03
        >>> result = refine_pose(start, p, uv, np.ones(50), (500.0, 500.0, 0.0, 0.0))
        >>> result.status.value, bool(np.allclose(result.T_c_w, np.eye(4), atol=1e-6))
        ('ok', True)
    """
    config = config or PoseConfig()
    start, uv, inv_sigma = _floats(T_c_w), _floats(uv).reshape(-1, 2), _floats(inv_sigma)
    points, n = _floats(p_w).reshape(-1, 3), len(uv)
    if len(points) != n or len(inv_sigma) != n:
        raise ValueError(f"{len(points)} points, {n} pixels and {len(inv_sigma)} sigmas must be equally many")
    if n < MIN_POINTS:
        return _failed(start, n, PoseStatus.FEW_POINTS)
    if not all(bool(np.isfinite(x).all()) for x in (start, points, uv, inv_sigma)):
        return _failed(start, n, PoseStatus.NOT_FINITE)
    slack = np.zeros((n, 2)) if slack_px is None else _floats(slack_px).reshape(-1, 2)
    known = _NO_PRIOR if prior is None else (_floats(prior.T_c_w)[None], _floats(prior.information)[None])
    fx, fy, cx, cy = (float(k) for k in K)
    T, H, chi2, count, iterations, converged = refined(
        start,
        (points, uv, inv_sigma, slack),
        (fx, fy, cx, cy),
        known,
        (config.rounds, config.robust_rounds, config.iterations),
        config.chi2,
        (_LEAST_STEP, config.cost_tolerance),
        _MIN_DEPTH,
        MIN_POINTS,
    )
    if count < MIN_POINTS:
        return _failed(start, n, PoseStatus.FEW_POINTS, iterations)
    if not np.isfinite(H).all():
        return _failed(start, n, PoseStatus.NOT_FINITE, iterations)
    scale = 1.0 / np.sqrt(np.maximum(H.diagonal(), 1e-30))
    values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    if values[0] <= values[-1] / _MAX_CONDITION:
        return _failed(start, n, PoseStatus.DEGENERATE, iterations)
    half = scale[:, None] * vectors / np.sqrt(values)
    return PoseResult(
        T_c_w=T,
        inliers=chi2 <= config.chi2,
        chi2=chi2,
        covariance=half @ half.T,
        iterations=iterations,
        status=PoseStatus.OK if converged else PoseStatus.NOT_CONVERGED,
    )


def _failed(T: FloatArray, n: int, status: PoseStatus, iterations: int = 0) -> PoseResult:
    return PoseResult(T, np.zeros(n, bool), np.full(n, np.inf), np.full((6, 6), np.nan), iterations, status)


def _floats(x: FloatArray) -> FloatArray:
    return np.ascontiguousarray(x, dtype=np.float64)


_NO_PRIOR = np.zeros((0, 4, 4)), np.zeros((0, 6, 6))
