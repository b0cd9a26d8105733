"""Robust refinement of one camera pose against fixed points."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.optim.kernels.pose import pose_equations
from edgeslam_torch.optim.kernels.tangents import logs
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray


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
    step_tolerance: float = 1e-6
    """Largest tangent component below which a round ends."""
    cost_tolerance: float = 1e-4
    """Relative decrease of the cost below which a round ends."""
    min_points: int = 6
    min_depth: float = 1e-3
    condition_max: float = 1e12
    """Condition number of the scaled normal matrix above which the pose is degenerate."""


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
    start: FloatArray = np.array(T_c_w, dtype=np.float64, order="C")
    points = _Points(p_w, uv, inv_sigma, K, slack_px, prior, config)
    n = len(points.use)
    if n < config.min_points:
        return _failed(start, n, PoseStatus.FEW_POINTS)
    if not (np.isfinite(start).all() and points.finite()):
        return _failed(start, n, PoseStatus.NOT_FINITE)
    T: FloatArray = start
    iterations, converged = 0, False
    for k in range(config.rounds):
        robust = k < config.robust_rounds
        T, used, converged = _round(T, points, robust, config)
        iterations += used
        inliers = points.chi2 <= config.chi2
        same = np.array_equal(inliers, points.use)
        if np.count_nonzero(inliers) < config.min_points:
            return _failed(start, n, PoseStatus.FEW_POINTS, iterations)
        points.use = inliers
        if same and converged and not robust:
            break
    H, _, _ = points.linearise(T, robust=False)
    if H is None:
        return _failed(start, n, PoseStatus.NOT_FINITE, iterations)
    scale = 1.0 / np.sqrt(np.maximum(H.diagonal(), 1e-30))
    values, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    if values[0] <= values[-1] / config.condition_max:
        return _failed(start, n, PoseStatus.DEGENERATE, iterations)
    half = scale[:, None] * vectors / np.sqrt(values)
    return PoseResult(
        T_c_w=T,
        inliers=points.chi2 <= config.chi2,
        chi2=points.chi2,
        covariance=half @ half.T,
        iterations=iterations,
        status=PoseStatus.OK if converged else PoseStatus.NOT_CONVERGED,
    )


def _failed(T: FloatArray, n: int, status: PoseStatus, iterations: int = 0) -> PoseResult:
    return PoseResult(T, np.zeros(n, bool), np.full(n, np.inf), np.full((6, 6), np.nan), iterations, status)


def _round(T: FloatArray, points: "_Points", robust: bool, config: PoseConfig) -> tuple[FloatArray, int, bool]:
    """Levenberg-Marquardt on the current inliers; ``points.chi2`` is that of the returned pose or one step before.

    A step with a predicted decrease below the tolerance is applied without evaluating its cost: the prediction is the
    squared step length in standard deviations, a fraction of one, and the next round linearises there anyway.
    """
    H, g, cost = points.linearise(T, robust)
    mu, used = 1e-6, 0
    if H is None:
        return T, used, False
    while used < config.iterations:
        used += 1
        damped = H.copy()
        damped[_DIAGONAL, _DIAGONAL] *= 1.0 + mu
        try:
            delta = -np.linalg.solve(damped, g)
        except np.linalg.LinAlgError:
            return T, used, False
        trial = se3.exp(delta) @ T
        if float(-g @ delta) <= config.cost_tolerance * cost:
            return trial, used, True
        chi2 = points.chi2
        H_new, g_new, cost_new = points.linearise(trial, robust)
        small = float(np.abs(delta).max()) < config.step_tolerance
        if H_new is None or not cost_new <= cost:
            points.chi2 = chi2
            if small:
                return T, used, True
            mu = max(10.0 * mu, 1e-3)
            continue
        flat = cost - cost_new <= config.cost_tolerance * cost
        T, H, g, cost, mu = trial, H_new, g_new, cost_new, 0.1 * mu
        if small or flat:
            return T, used, True
    return T, used, False


class _Points:
    """Points of one refinement."""

    def __init__(
        self,
        p_w: FloatArray,
        uv: FloatArray,
        inv_sigma: FloatArray,
        K: tuple[float, float, float, float],
        slack_px: FloatArray | None,
        prior: PosePrior | None,
        config: PoseConfig,
    ) -> None:
        self.p_w, self.uv = _floats(p_w).reshape(-1, 3), _floats(uv).reshape(-1, 2)
        self.inv_sigma, (fx, fy, cx, cy) = _floats(inv_sigma), (float(k) for k in K)
        self.K = fx, fy, cx, cy
        n = len(self.uv)
        if len(self.p_w) != n or len(self.inv_sigma) != n:
            raise ValueError(f"{len(self.p_w)} points, {n} pixels and {len(inv_sigma)} sigmas must be equally many")
        self.slack = np.zeros((n, 2)) if slack_px is None else _floats(slack_px).reshape(-1, 2)
        self.prior, self.config = prior, config
        self.use = np.ones(n, dtype=bool)
        self.chi2 = np.full(n, np.inf)

    def finite(self) -> bool:
        """Whether every input is finite."""
        return all(bool(np.isfinite(x).all()) for x in (self.p_w, self.uv, self.inv_sigma))

    def linearise(self, T: FloatArray, robust: bool) -> tuple[FloatArray | None, FloatArray, float]:
        """Normal matrix, gradient and cost over the points in use; sets ``chi2`` of all points."""
        config = self.config
        points = self.p_w, self.uv, self.inv_sigma, self.slack, self.K, self.use
        H, g, cost, self.chi2 = pose_equations(T, *points, robust, config.chi2, config.min_depth)
        if self.prior is not None:
            (e,), (J,) = logs((T @ se3.inverse(np.asarray(self.prior.T_c_w, dtype=np.float64)))[None])
            H += J.T @ self.prior.information @ J
            g += J.T @ (self.prior.information @ e)
            cost += float(e @ self.prior.information @ e)
        return (H if np.isfinite(cost) else None), g, cost


def _floats(x: FloatArray) -> FloatArray:
    return np.ascontiguousarray(x, dtype=np.float64)


_DIAGONAL = np.arange(6)
