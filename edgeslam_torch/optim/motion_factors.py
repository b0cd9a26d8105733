r"""Residuals of camera positions, gravity and headings: inertial and other motion measurements of a window.

Positions come as one Gaussian, :math:`\chi^2 = c^T A c - 2 b^T c + k` of the stacked camera centres
:math:`c_i = -R_i^T t_i`, whose derivative by a left perturbation :math:`(\rho, \phi)` of the pose is
:math:`-R_i^T \rho`: the translation alone. Gravity is a direction in the camera, :math:`R_i g - u_i`, with the
derivative :math:`-[R_i g]_\times \phi`. A heading is the rotation about the vertical from a measured rotation
:math:`M_i`: of :math:`E_i = M_i^T R_i`, with angle :math:`\theta_i` and axis :math:`a_i`, the part
:math:`\sin\theta_i\, g^T a_i`, with the derivative
:math:`\tfrac12 g^T (\mathrm{tr}(E_i) I - E_i)\, M_i^T \phi`.
"""

import numpy as np

from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.optim.problem import CentreFactor, GravityFactor, HeadingFactor
from edgeslam_torch.types import FloatArray, IntArray


class MotionTerms:
    """Motion factors of one window; adds itself to the normal equations."""

    def __init__(
        self,
        centres: tuple[CentreFactor, ...],
        gravity: tuple[GravityFactor, ...],
        headings: tuple[HeadingFactor, ...],
        column: IntArray,
    ) -> None:
        """Prepare the terms.

        Args:
            centres: Gaussians of camera centres.
            gravity: Up directions.
            headings: Gaussians of rotations about the vertical.
            column: Free-pose number of each pose, -1 for a fixed one.
        """
        self.centres = _together(centres, len(column))
        self.gravity, self.headings = gravity, headings
        self.column, self.free = column, np.flatnonzero(column >= 0)

    def linearise(self, T: FloatArray, H: FloatArray, g: FloatArray) -> float:
        """Add the terms at poses ``(W, 4, 4)`` to ``H (6F, 6F)`` and ``g (6F,)``; returns their cost."""
        F = len(self.free)
        blocks, g, total = H.reshape(F, 6, F, 6), g.reshape(F, 6), 0.0
        if self.centres is not None:
            total, by_centre = centre_cost(T, self.centres)
            R = T[self.free, :3, :3]
            g[:, :3] -= (R @ by_centre[self.free, :, None])[:, :, 0]
            # R_i A_ij R_j^T, by rows and then by columns.
            rows = R @ self.centres.information.reshape(-1, 3, 3 * len(T))[self.free]
            both = rows.reshape(3 * F, -1, 3).transpose(1, 0, 2)[self.free] @ np.swapaxes(R, 1, 2)
            blocks[:, :3, :, :3] += both.reshape(F, F, 3, 3).transpose(1, 2, 0, 3)
        for gravity in self.gravity:
            r = gravity_residual(T[gravity.pose], gravity)
            J = gravity_jacobian(T[gravity.pose], gravity)
            total += float(np.sum(r**2))
            free, into = self._free(gravity.pose)
            J_t = np.swapaxes(J[free], 1, 2)
            blocks[into, 3:, into, 3:] += J_t @ J[free]
            g[into, 3:] += (J_t @ r[free, :, None])[:, :, 0]
        for heading in self.headings:
            e, J = heading_residual(T[heading.pose], heading), heading_jacobian(T[heading.pose], heading)
            slope = heading.information @ e
            total += float(e @ slope)
            free, into = self._free(heading.pose)
            g[into, 3:] += J[free] * slope[free, None]
            by_pose, information = np.zeros((F, 3)), np.zeros((F, F))
            by_pose[into], information[np.ix_(into, into)] = J[free], heading.information[np.ix_(free, free)]
            blocks[:, 3:, :, 3:] += by_pose[:, :, None, None] * (information[:, :, None] * by_pose)[:, None]
        return total

    def _free(self, pose: IntArray) -> tuple[IntArray, IntArray]:
        """Which of poses ``(n,)``, each once, are free, and their free-pose numbers."""
        column = self.column[pose]
        free = np.flatnonzero(column >= 0)
        return free, column[free]


def _together(centres: tuple[CentreFactor, ...], poses: int) -> CentreFactor | None:
    """One Gaussian of all camera centres; None without any."""
    if not centres:
        return None
    information, vector = np.zeros((poses, 3, poses, 3)), np.zeros((poses, 3))
    for centre in centres:
        K = len(centre.pose)
        blocks = centre.information.reshape(K, 3, K, 3).transpose(0, 2, 1, 3)
        information[centre.pose[:, None], :, centre.pose] += blocks
        vector[centre.pose] += centre.vector.reshape(K, 3)
    constant = sum(centre.constant for centre in centres)
    return CentreFactor(np.arange(poses), information.reshape(3 * poses, -1), vector.ravel(), constant)


def centre_cost(T_c_w: FloatArray, factor: CentreFactor) -> tuple[float, FloatArray]:
    """Chi-square of camera centres ``(K, 4, 4)``, and half its derivative by them ``(K, 3)``."""
    c = -np.einsum("kba,kb->ka", T_c_w[:, :3, :3], T_c_w[:, :3, 3]).ravel()
    slope = factor.information @ c - factor.vector
    return float(c @ slope - factor.vector @ c) + factor.constant, slope.reshape(-1, 3)


def gravity_residual(T_c_w: FloatArray, factor: GravityFactor) -> FloatArray:
    """Predicted minus measured up direction in units of its sigma ``(U, 3)``."""
    return np.asarray((T_c_w[:, :3, :3] @ factor.up_w - factor.up_c) / factor.sigma_rad)


def gravity_jacobian(T_c_w: FloatArray, factor: GravityFactor) -> FloatArray:
    """Derivative of `gravity_residual` by the rotation of a left perturbation ``(U, 3, 3)``."""
    return np.asarray(-hat(T_c_w[:, :3, :3] @ factor.up_w) / factor.sigma_rad)


def heading_residual(T_c_w: FloatArray, factor: HeadingFactor) -> FloatArray:
    """Sine of the rotation about the vertical from measured to predicted rotations ``(U,)``."""
    E = np.swapaxes(factor.R_c_w, 1, 2) @ T_c_w[:, :3, :3]
    return np.asarray(0.5 * np.einsum("a,ua->u", factor.up_w, _antisymmetric(E)))


def heading_jacobian(T_c_w: FloatArray, factor: HeadingFactor) -> FloatArray:
    """Derivative of `heading_residual` by the rotation of a left perturbation ``(U, 3)``."""
    M_T = np.swapaxes(factor.R_c_w, 1, 2)
    E = M_T @ T_c_w[:, :3, :3]
    trace = np.trace(E, axis1=1, axis2=2)[:, None, None]
    return np.asarray(0.5 * np.einsum("a,uab,ubc->uc", factor.up_w, trace * np.eye(3) - E, M_T))


def _antisymmetric(E: FloatArray) -> FloatArray:
    """Vectors ``(U, 3)`` whose cross product is ``E - E^T``."""
    D = E - np.swapaxes(E, 1, 2)
    return np.stack([D[:, 2, 1], D[:, 0, 2], D[:, 1, 0]], axis=1)
