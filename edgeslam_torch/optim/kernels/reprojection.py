"""Reprojection and depth priors of anchors, paper eqs. (15)-(16); `losses.reprojection` defines the former.

With the point :math:`P = R p + t` in the camera, its normalised coordinates :math:`x = X/Z, y = Y/Z` and a left tangent
:math:`(\\rho, \\phi)` of the pose, :math:`dP = \\rho + \\phi \\times P + R\\, dp`.
"""

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

MIN_DEPTH = 1e-6
"""Minimum depth of a point in front of the camera [map units]."""
LEAST_SHRINKAGE = 0.1
"""Lower bound of an anchor's inverse distance after a step, relative to that before."""


@compiled("f8[:,:,::1], f8[:,::1], i8[::1], i8[::1], f8[:,::1], f8[::1], UniTuple(f8, 4)")
def reprojection(
    T_c_w: FloatArray,
    p_w: FloatArray,
    pose: IntArray,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    K: tuple[float, float, float, float],
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Whitened residuals of observations, their derivatives, and which lie in front of the camera.

    Args:
        T_c_w: World-to-camera poses ``(W, 4, 4)``.
        p_w: Anchors ``(A, 3)``.
        pose: ``(O,)`` observing pose.
        anchor: ``(O,)`` observed anchor.
        uv: ``(O, 2)`` undistorted pixels.
        inv_sigma: ``(O,)`` inverse standard deviations [1/px].
        K: fx, fy, cx, cy [px].

    Returns:
        Residuals ``(O, 2)``; derivatives ``(O, 2, 9)`` by the pose's left tangent and by the anchor; and ``(O,)``
        whether each is in front of the camera.
    """
    fx, fy, cx, cy = K
    r, J, front = np.zeros((len(pose), 2)), np.empty((len(pose), 2, 9)), np.zeros(len(pose), np.bool_)
    for o in range(len(pose)):
        T, p = T_c_w[pose[o]], p_w[anchor[o]]
        X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not Z > MIN_DEPTH:
            J[o] = 0.0
            continue
        front[o] = True
        iz = 1.0 / Z
        x, y = X * iz, Y * iz
        a, b = fx * inv_sigma[o], fy * inv_sigma[o]
        r[o, 0] = a * x + (cx - uv[o, 0]) * inv_sigma[o]
        r[o, 1] = b * y + (cy - uv[o, 1]) * inv_sigma[o]
        J[o, 0, 0], J[o, 0, 1], J[o, 0, 2] = a * iz, 0.0, -a * x * iz
        J[o, 0, 3], J[o, 0, 4], J[o, 0, 5] = -a * x * y, a * (1.0 + x * x), -a * y
        J[o, 1, 0], J[o, 1, 1], J[o, 1, 2] = 0.0, b * iz, -b * y * iz
        J[o, 1, 3], J[o, 1, 4], J[o, 1, 5] = -b * (1.0 + y * y), b * x * y, b * x
        for i in range(3):
            J[o, 0, 6 + i] = a * iz * (T[0, i] - x * T[2, i])
            J[o, 1, 6 + i] = b * iz * (T[1, i] - y * T[2, i])
    return r, J, front


@compiled("f8[:,:,::1], f8[:,::1], i8[::1], i8[::1], f8[::1], f8[::1]")
def inverse_depth(
    T_c_w: FloatArray, p_w: FloatArray, pose: IntArray, anchor: IntArray, prior: FloatArray, inv_sigma: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Whitened predicted minus expected inverse depth; arguments and results as `reprojection`, one row each.

    Args:
        T_c_w: World-to-camera poses ``(W, 4, 4)``.
        p_w: Anchors ``(A, 3)``.
        pose: ``(D,)`` host poses.
        anchor: ``(D,)`` anchors.
        prior: ``(D,)`` expected inverse depth [1/map unit].
        inv_sigma: ``(D,)`` its inverse standard deviation [map units].
    """
    r, J, front = np.zeros((len(pose), 1)), np.zeros((len(pose), 1, 9)), np.zeros(len(pose), np.bool_)
    for o in range(len(pose)):
        T, p = T_c_w[pose[o]], p_w[anchor[o]]
        X = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        Y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        Z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if not Z > MIN_DEPTH:
            continue
        front[o] = True
        iz = 1.0 / Z
        r[o, 0] = (iz - prior[o]) * inv_sigma[o]
        slope = -iz * iz * inv_sigma[o]  # by Z
        J[o, 0, 2], J[o, 0, 3], J[o, 0, 4] = slope, slope * Y, -slope * X
        for i in range(3):
            J[o, 0, 6 + i] = slope * T[2, i]
    return r, J, front


@compiled("f8[:,:,::1], f8[:,::1], i8[::1], f8[:,::1]")
def stepped(T_c_w: FloatArray, p_w: FloatArray, host: IntArray, step: FloatArray) -> FloatArray:
    """Anchors ``(A, 3)`` after a step that is linear in their inverse distance from the pose ``host (A,)``.

    With the point at distance d from that camera, and the step's part a d along the ray, the inverse distance becomes
    (1 - a) / d. Linear steps of points would overshoot where there is little parallax.
    """
    out = np.empty(p_w.shape)
    for n in range(len(p_w)):
        T, along, square = T_c_w[host[n]], 0.0, 1e-12
        for i in range(3):
            ray = p_w[n, i] + T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3]
            along += step[n, i] * ray
            square += ray * ray
        nearer = max(1.0 - along / square, LEAST_SHRINKAGE)
        for i in range(3):
            out[n, i] = p_w[n, i] + step[n, i] / nearer
    return out
