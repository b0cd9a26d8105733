"""Priors on poses and scale as residuals of the window."""

import math

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.problem import PosePrior, RelativePosePrior, ScalePrior
from edgeslam_torch.types import FloatArray, IntArray

_BERNOULLI = (-0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30240.0)
"""B_n / n! for n = 1..6, the series of the inverse left Jacobian."""


class PriorTerms:
    """Pose and scale priors of one window; adds itself to the normal equations."""

    def __init__(
        self,
        poses: tuple[PosePrior, ...],
        scales: tuple[ScalePrior, ...],
        column: IntArray,
        relative: tuple[RelativePosePrior, ...] = (),
    ) -> None:
        """Prepare the terms.

        Args:
            poses: Pose priors.
            scales: Priors on distances between camera centres.
            column: Free-pose number of each pose, -1 for a fixed one.
            relative: Priors on relative poses.
        """
        self.poses = [p for p in poses if column[p.pose] >= 0]
        self.relative = [p for p in relative if column[p.pose_i] >= 0 or column[p.pose_j] >= 0]
        self.scales = [p for p in scales if column[p.pose_i] >= 0 or column[p.pose_j] >= 0]
        self.column = column

    def linearise(self, T: FloatArray, H: FloatArray, g: FloatArray) -> float:
        """Add the terms at poses ``(W, 4, 4)`` to ``H (6F, 6F)`` and ``g (6F,)``; returns their cost."""
        total = 0.0
        for prior in self.poses:
            r = pose_prior_residual(T[prior.pose], prior)
            J = inverse_left_jacobian(r)
            k = 6 * self.column[prior.pose]
            H[k : k + 6, k : k + 6] += J.T @ prior.information @ J
            g[k : k + 6] += J.T @ (prior.information @ r)
            total += float(r @ prior.information @ r)
        for relation in self.relative:
            r, by_i, by_j = relative_prior(T[relation.pose_i], T[relation.pose_j], relation)
            total += float(r @ relation.information @ r)
            blocks = [(relation.pose_i, by_i), (relation.pose_j, by_j)]
            free = [(slice(6 * k, 6 * k + 6), J) for pose, J in blocks if (k := self.column[pose]) >= 0]
            for rows, J in free:
                weighted = J.T @ relation.information
                g[rows] += weighted @ r
                for columns, other in free:
                    H[rows, columns] += weighted @ other
        for scale in self.scales:
            r_s, J_i, J_j = scale_prior(T[scale.pose_i], T[scale.pose_j], scale)
            total += r_s**2
            row = np.zeros(len(g))
            for pose, J in ((scale.pose_i, J_i), (scale.pose_j, J_j)):
                k = 6 * self.column[pose]
                if k >= 0:
                    row[k : k + 6] += J
            H += np.outer(row, row)
            g += r_s * row
        return total


def pose_prior_residual(T_c_w: np.ndarray, prior: PosePrior) -> np.ndarray:
    """Tangent ``(6,)`` that takes the prior's pose to ``T_c_w`` from the left."""
    return se3.log(T_c_w @ se3.inverse(np.asarray(prior.T_c_w, dtype=np.float64)))


def inverse_left_jacobian(xi: np.ndarray) -> np.ndarray:
    """``(6, 6)`` with ``log(exp(d) exp(xi)) = xi + J d``; series, for rotations below a radian."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = se3.hat(xi[3:])
    ad[:3, 3:] = se3.hat(xi[:3])
    J, power = np.eye(6), np.eye(6)
    for coefficient in _BERNOULLI:
        power = power @ ad
        if coefficient:
            J += coefficient * power
    return J


def relative_prior(T_i: np.ndarray, T_j: np.ndarray, prior: RelativePosePrior) -> tuple[np.ndarray, ...]:
    """Tangent ``(6,)`` from the expected relative pose to ``T_j T_i^-1``, and its derivatives by both left tangents."""
    T_j_i = T_j @ se3.inverse(T_i)
    r = se3.log(T_j_i @ se3.inverse(np.asarray(prior.T_j_i, dtype=np.float64)))
    J = inverse_left_jacobian(r)
    return r, -J @ se3.adjoint(T_j_i), J


def scale_prior(T_i: np.ndarray, T_j: np.ndarray, prior: ScalePrior) -> tuple[float, np.ndarray, np.ndarray]:
    """Whitened log of distance over expected distance; its derivatives ``(6,)`` by both left tangents."""
    R_i, R_j = T_i[:3, :3], T_j[:3, :3]
    between = R_j.T @ T_j[:3, 3] - R_i.T @ T_i[:3, 3]  # c_i - c_j
    distance = max(float(np.linalg.norm(between)), 1e-12)
    r = math.log(distance / prior.distance) / prior.sigma_log
    along = between / (distance * distance * prior.sigma_log)
    zero = np.zeros(3)
    return r, np.concatenate([-R_i @ along, zero]), np.concatenate([R_j @ along, zero])
