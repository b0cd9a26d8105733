"""L-junctions projected into other poses: corner, and arms or the angle between them, paper eqs. (24)-(25).

`losses.lshape.junction_residuals` defines them. Corner and arm ends have an inverse depth each and project as in
`optim.kernels.edges`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

MIN_DEPTH = 1e-6
"""As in `optim.kernels.edges`."""
MIN_ARM_PX = 1e-6
"""Minimum divisor for the length of an arm."""


@compiled("f8[:,:,::1], i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], f8[:,::1], f8[:,:,::1], f8, f8, b1, UniTuple(f8, 4)")
def junctions(
    T_j_i: FloatArray,
    view: IntArray,
    junction: IntArray,
    uv: FloatArray,
    inverse_depth: FloatArray,
    uv_j: FloatArray,
    arms_j: FloatArray,
    inv_sigma_px: float,
    inv_sigma_angle: float,
    cosines: bool,
    K: tuple[float, float, float, float],
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Whitened residuals of junctions, their derivatives, and which lie in front.

    Args:
        T_j_i: Relative poses ``(R, 4, 4)``, host to target.
        view: ``(Q,)`` relative pose of each pair.
        junction: ``(Q,)`` its junction.
        uv: ``(C, 3, 2)`` corner and arm ends in their hosts.
        inverse_depth: ``(C, 3)`` there.
        uv_j: ``(Q, 2)`` the corner in the target.
        arms_j: ``(Q, 2, 2)`` unit directions of the arms there.
        inv_sigma_px: Inverse standard deviation of a corner [1/px].
        inv_sigma_angle: Inverse standard deviation of an angle row.
        cosines: One row, the cosine between the arms, instead of the sine between each arm and the observed one.
        K: fx, fy, cx, cy [px].

    Returns:
        Residuals ``(Q, 3 or 4)``: corner u and v, then the angle rows; derivatives ``(Q, 3 or 4, 9)`` by the relative
        pose's left tangent and by the three inverse depths; and ``(Q,)`` whether each is in front of the camera.
    """
    fx, fy, cx, cy = K
    rows = 3 if cosines else 4
    r, J = np.zeros((len(view), rows)), np.zeros((len(view), rows, 9))
    front = np.zeros(len(view), np.bool_)
    at, slope = np.empty((3, 2)), np.zeros((3, 2, 9))  # pixels of corner and ends in the target, and derivatives
    arm, length, by_arm = np.empty((2, 2)), np.empty(2), np.empty(2)
    for k in range(len(view)):
        T, c = T_j_i[view[k]], junction[k]
        behind = False
        for e in range(3):
            d = inverse_depth[c, e]
            ray_x, ray_y = (uv[c, e, 0] - cx) / fx, (uv[c, e, 1] - cy) / fy
            X = T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2] + T[0, 3] * d
            Y = T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2] + T[1, 3] * d
            Z = T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2] + T[2, 3] * d
            if not Z > MIN_DEPTH:
                behind = True
                break
            x, y, iz = X / Z, Y / Z, d / Z
            at[e, 0], at[e, 1] = fx * x + cx, fy * y + cy
            slope[e, 0, 0], slope[e, 0, 2] = fx * iz, -fx * x * iz
            slope[e, 0, 3], slope[e, 0, 4], slope[e, 0, 5] = -fx * x * y, fx * (1.0 + x * x), -fx * y
            slope[e, 1, 1], slope[e, 1, 2] = fy * iz, -fy * y * iz
            slope[e, 1, 3], slope[e, 1, 4], slope[e, 1, 5] = -fy * (1.0 + y * y), fy * x * y, fy * x
            slope[e, 0, 6 + e] = fx * (T[0, 3] - x * T[2, 3]) / Z
            slope[e, 1, 6 + e] = fy * (T[1, 3] - y * T[2, 3]) / Z
        if behind:
            continue
        front[k] = True
        for i in range(2):
            r[k, i] = (at[0, i] - uv_j[k, i]) * inv_sigma_px
            for m in range(9):
                J[k, i, m] = slope[0, i, m] * inv_sigma_px
        for n in range(2):
            u, v = at[1 + n, 0] - at[0, 0], at[1 + n, 1] - at[0, 1]
            length[n] = max(math.sqrt(u * u + v * v), MIN_ARM_PX)
            arm[n, 0], arm[n, 1] = u / length[n], v / length[n]
        cosine = arm[0, 0] * arm[1, 0] + arm[0, 1] * arm[1, 1]
        if cosines:
            seen = arms_j[k, 0, 0] * arms_j[k, 1, 0] + arms_j[k, 0, 1] * arms_j[k, 1, 1]
            r[k, 2] = (cosine - seen) * inv_sigma_angle
        for n in range(2):
            row = 2 if cosines else 2 + n
            if cosines:
                for i in range(2):
                    by_arm[i] = (arm[1 - n, i] - cosine * arm[n, i]) / length[n]
            else:
                sine = arms_j[k, n, 0] * arm[n, 1] - arms_j[k, n, 1] * arm[n, 0]
                r[k, row] = sine * inv_sigma_angle
                by_arm[0] = (-arms_j[k, n, 1] - sine * arm[n, 0]) / length[n]
                by_arm[1] = (arms_j[k, n, 0] - sine * arm[n, 1]) / length[n]
            for i in range(2):
                for m in range(9):
                    J[k, row, m] += by_arm[i] * (slope[1 + n, i, m] - slope[0, i, m]) * inv_sigma_angle
    return r, J, front
