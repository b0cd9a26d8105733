"""Edge pixels projected into other poses: distance across the edge and depth cycle, paper eqs. (17)-(23).

`losses.edge_alignment` and `losses.cycle` define them. A pixel with the ray :math:`u` and the inverse depth :math:`d`
in its host lies at :math:`q = R u + d t` in the target, up to the factor :math:`1/d`: points at infinity need no
special case. Derivatives are by the left tangent of the relative pose, six parameters for any window size.
"""

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

MIN_DEPTH = 1e-6
"""Minimum depth of a point in front of the camera, relative to its depth in the host."""
NONE, RELATIVE_DEPTH, PIXEL = range(3)
"""Forms of the cycle."""


@compiled(
    "f8[:,:,::1], i8[::1], i8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], i8, f8, UniTuple(f8, 4)"
)
def edges(
    T_j_i: FloatArray,
    view: IntArray,
    edge: IntArray,
    uv: FloatArray,
    inverse_depth: FloatArray,
    uv_j: FloatArray,
    normal_j: FloatArray,
    inv_sigma: FloatArray,
    inverse_depth_j: FloatArray,
    cycle: int,
    cycle_inv_sigma: float,
    K: tuple[float, float, float, float],
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Whitened residuals of pairs of an edge pixel and its partner, their derivatives, and which lie in front.

    Args:
        T_j_i: Relative poses ``(R, 4, 4)``, host to target.
        view: ``(P,)`` relative pose of each pair.
        edge: ``(P,)`` its edge pixel.
        uv: ``(E, 2)`` edge pixels in their hosts.
        inverse_depth: ``(E,)`` there.
        uv_j: ``(P, 2)`` partners in the target.
        normal_j: ``(P, 2)`` their unit normals.
        inv_sigma: ``(P,)`` inverse standard deviation across the edge [1/px].
        inverse_depth_j: ``(P,)`` the target's inverse depth of the partner; 0 for none.
        cycle: Form of the cycle: `NONE`, `RELATIVE_DEPTH` or `PIXEL`.
        cycle_inv_sigma: Inverse standard deviation of the cycle, in its own unit.
        K: fx, fy, cx, cy [px].

    Returns:
        Residuals ``(P, 1 + cycle)``: alignment, then the cycle; derivatives ``(P, 1 + cycle, 7)`` by the relative
        pose's left tangent and by the inverse depth; and ``(P,)`` whether each is in front of the camera.
    """
    fx, fy, cx, cy = K
    r, J = np.zeros((len(view), 1 + cycle)), np.zeros((len(view), 1 + cycle, 7))
    front = np.zeros(len(view), np.bool_)
    D = np.empty(3)
    for k in range(len(view)):
        T, e = T_j_i[view[k]], edge[k]
        d = inverse_depth[e]
        ray_x, ray_y = (uv[e, 0] - cx) / fx, (uv[e, 1] - cy) / fy
        X = T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2] + T[0, 3] * d
        Y = T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2] + T[1, 3] * d
        Z = T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2] + T[2, 3] * d
        if not Z > MIN_DEPTH:
            continue
        front[k] = True
        scale = 1.0 / Z
        x, y, iz = X * scale, Y * scale, d * scale  # normalised coordinates and inverse depth in the target
        x_d, y_d = (T[0, 3] - x * T[2, 3]) * scale, (T[1, 3] - y * T[2, 3]) * scale  # by d

        a, b = normal_j[k, 0] * fx * inv_sigma[k], normal_j[k, 1] * fy * inv_sigma[k]
        r[k, 0] = (
            a * x + b * y + (normal_j[k, 0] * (cx - uv_j[k, 0]) + normal_j[k, 1] * (cy - uv_j[k, 1])) * inv_sigma[k]
        )
        along = a * x + b * y
        J[k, 0, 0], J[k, 0, 1], J[k, 0, 2] = a * iz, b * iz, -along * iz
        J[k, 0, 3], J[k, 0, 4], J[k, 0, 5] = -b - along * y, a + along * x, b * x - a * y
        J[k, 0, 6] = a * x_d + b * y_d

        known = inverse_depth_j[k]
        if cycle == RELATIVE_DEPTH and known > 0.0:  # (z - z_j) / (z + z_j), by inverse depths
            both = 1.0 / (known + iz)
            r[k, 1] = (known - iz) * both * cycle_inv_sigma
            slope = -2.0 * known * both * both * cycle_inv_sigma  # by iz
            J[k, 1, 2], J[k, 1, 3], J[k, 1, 4] = -slope * iz * iz, -slope * iz * y, slope * iz * x
            J[k, 1, 6] = slope * scale * (1.0 - iz * T[2, 3])
        if cycle == PIXEL and known > 0.0:  # to the target's depth and back into the host
            px, py, pz = x - T[0, 3] * known, y - T[1, 3] * known, 1.0 - T[2, 3] * known
            Z = T[0, 2] * px + T[1, 2] * py + T[2, 2] * pz
            if not Z > MIN_DEPTH:
                continue
            for i in range(2):
                f, at = (fx, ray_x) if i == 0 else (fy, ray_y)
                f *= cycle_inv_sigma
                back = (T[0, i] * px + T[1, i] * py + T[2, i] * pz) / Z
                r[k, 1 + i] = (back - at) * f
                for m in range(3):  # by the point at the target's depth
                    D[m] = (T[m, i] - back * T[m, 2]) * f / Z
                # The projection depends on the pose, and the back-projection on its inverse: opposite signs.
                J[k, 1 + i, 0] = D[0] * (iz - known)
                J[k, 1 + i, 1] = D[1] * (iz - known)
                J[k, 1 + i, 2] = -(D[0] * x + D[1] * y) * iz - D[2] * known
                J[k, 1 + i, 3] = -D[0] * x * y - D[1] * (1.0 + y * y) - D[2] * y + D[1]
                J[k, 1 + i, 4] = D[0] * (1.0 + x * x) + D[1] * x * y - D[0] + D[2] * x
                J[k, 1 + i, 5] = 0.0
                J[k, 1 + i, 6] = D[0] * x_d + D[1] * y_d
    return r, J, front
