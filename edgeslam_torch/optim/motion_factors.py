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
        self.centres, self.gravity, self.headings = centres, gravity, headings
        self.column = column

    def linearise(self, T: FloatArray, H: FloatArray, g: FloatArray) -> float:
        """Add the terms at poses ``(W, 4, 4)`` to ``H (6F, 6F)`` and ``g (6F,)``; returns their cost."""
        F = len(H) // 6
        H, g = H.reshape(F, 6, F, 6), g.reshape(F, 6)
        total = 0.0
        for centre in self.centres:
            value, by_centre = centre_cost(T[centre.pose], centre)
            total += value
            column = self.column[centre.pose]
            free = np.flatnonzero(column >= 0)
            into, R = column[free], T[centre.pose[free], :3, :3]
            K = len(centre.pose)
            A = centre.information.reshape(K, 3, K, 3)[free][:, :, free]
            np.add.at(g[:, :3], into, -np.einsum("kab,kb->ka", R, by_centre[free]))
            turned = np.einsum("iab,ibjd,jcd->iajc", R, A, R)
            H[into[:, None], :3, into[None], :3] += turned.transpose(0, 2, 1, 3)
        for gravity in self.gravity:
            r = gravity_residual(T[gravity.pose], gravity)
            J = gravity_jacobian(T[gravity.pose], gravity)
            total += float(np.sum(r**2))
            for k, i in enumerate(self.column[gravity.pose]):
                if i >= 0:
                    H[i, 3:, i, 3:] += J[k].T @ J[k]
                    g[i, 3:] += J[k].T @ r[k]
        for heading in self.headings:
            e, J = heading_residual(T[heading.pose], heading), heading_jacobian(T[heading.pose], heading)
            slope = heading.information @ e
            total += float(e @ slope)
            column = self.column[heading.pose]
            free = np.flatnonzero(column >= 0)
            into, J = column[free], J[free]
            np.add.at(g[:, 3:], into, J * slope[free, None])
            curvature = np.einsum("ia,ij,jb->ijab", J, heading.information[np.ix_(free, free)], J)
            H[into[:, None], 3:, into[None], 3:] += curvature
        return total


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
