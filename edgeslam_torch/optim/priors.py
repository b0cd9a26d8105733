"""Priors on poses and scale as residuals of the window."""

import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.blocks import add_blocks
from edgeslam_torch.optim.kernels.pose import logs
from edgeslam_torch.optim.problem import RelativePosePrior, ScalePrior
from edgeslam_torch.types import FloatArray, IntArray


class PriorTerms:
    """Priors on relative poses and on the scale of one window; adds itself to the normal equations."""

    def __init__(self, relative: Sequence[RelativePosePrior], scales: Sequence[ScalePrior], column: IntArray) -> None:
        """Prepare the terms.

        Args:
            relative: Priors on relative poses.
            scales: Priors on distances between camera centres.
            column: Free-pose number of each pose, -1 for a fixed one.
        """
        self.column = column
        relative = [p for p in relative if column[p.pose_i] >= 0 or column[p.pose_j] >= 0]
        self.i, self.j = (np.array([getattr(p, k) for p in relative], dtype=np.int64) for k in ("pose_i", "pose_j"))
        self.expected = np.array([p.T_j_i for p in relative], dtype=np.float64).reshape(-1, 4, 4)
        self.information = np.array([p.information for p in relative], dtype=np.float64).reshape(-1, 6, 6)
        self.scales = [p for p in scales if column[p.pose_i] >= 0 or column[p.pose_j] >= 0]

    def linearise(self, T: FloatArray, H: FloatArray, g: FloatArray) -> float:
        """Add the terms at poses ``(W, 4, 4)`` to ``H (6F, 6F)`` and ``g (6F,)``; returns their cost."""
        total = 0.0
        if len(self.i):
            r, J_i, J_j = relative_priors(T[self.i], T[self.j], self.expected)
            slope = (self.information @ r[:, :, None])[:, :, 0]
            total += float((r * slope).sum())
            sides = [(self.column[self.i], np.swapaxes(J_i, 1, 2)), (self.column[self.j], np.swapaxes(J_j, 1, 2))]
            for row, J_t in sides:
                free, weighted = row >= 0, J_t @ self.information
                np.add.at(g.reshape(-1, 6), row[free], (J_t @ slope[:, :, None])[free, :, 0])
                for column, other_t in sides:
                    add_blocks(H, row, column, weighted @ np.swapaxes(other_t, 1, 2))
        for scale in self.scales:
            r_s, by_i, by_j = scale_prior(T[scale.pose_i], T[scale.pose_j], scale)
            total += r_s**2
            slope_s = np.zeros(len(g))
            for pose, J in ((scale.pose_i, by_i), (scale.pose_j, by_j)):
                k = 6 * self.column[pose]
                if k >= 0:
                    slope_s[k : k + 6] += J
            H += np.outer(slope_s, slope_s)
            g += r_s * slope_s
        return total


def relative_priors(T_i: FloatArray, T_j: FloatArray, T_j_i: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tangents ``(n, 6)`` from expected relative poses to ``T_j T_i^-1``, and their derivatives ``(n, 6, 6)`` by the
    left tangents of ``T_i`` and of ``T_j``, all ``(n, 4, 4)``."""
    actual = T_j @ se3.inverse(T_i)
    r, J = logs(actual @ se3.inverse(T_j_i))
    return r, -J @ se3.adjoint(actual), J


def scale_prior(T_i: FloatArray, T_j: FloatArray, prior: ScalePrior) -> tuple[float, FloatArray, FloatArray]:
    """Whitened log of distance over expected distance; its derivatives ``(6,)`` by both left tangents."""
    R_i, R_j = T_i[:3, :3], T_j[:3, :3]
    between = R_j.T @ T_j[:3, 3] - R_i.T @ T_i[:3, 3]  # c_i - c_j
    distance = max(float(np.linalg.norm(between)), 1e-12)
    r = math.log(distance / prior.distance) / prior.sigma_log
    along = between / (distance * distance * prior.sigma_log)
    zero = np.zeros(3)
    return r, np.concatenate([-R_i @ along, zero]), np.concatenate([R_j @ along, zero])
