"""Normal equations of one pose against fixed points."""

import math

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray

FAR_SIGMA = 1000.0
"""Residual of a point behind the camera [standard deviations]."""


@compiled
def pose_equations(
    T_c_w: FloatArray,
    p_w: FloatArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    slack: FloatArray,
    K: tuple[float, float, float, float],
    use: NDArray[np.bool_],
    robust: bool,
    limit: float,
    min_depth: float,
) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """Sum the normal equations over the points in use.

    Args:
        T_c_w: Pose ``(4, 4)``.
        p_w: Points ``(N, 3)``.
        uv: Their undistorted pixels ``(N, 2)``.
        inv_sigma: Inverse standard deviations ``(N,)`` [1/px].
        slack: Additional standard deviation along one direction ``(N, 2)`` [px].
        K: fx, fy, cx, cy [px].
        use: ``(N,)`` points in use.
        robust: Huber's kernel with threshold ``limit`` instead of squares.
        limit: Squared whitened residual.
        min_depth: Minimum depth of a point in front of the camera.

    Returns:
        Normal matrix ``(6, 6)``, gradient ``(6,)``, cost, and squared whitened residuals of all points ``(N,)``,
        infinite behind the camera.
    """
    fx, fy, cx, cy = K
    H, g, chi2, cost = np.zeros((6, 6)), np.zeros(6), np.full(len(uv), np.inf), 0.0
    delta = math.sqrt(limit)
    far = 2.0 * delta * FAR_SIGMA if robust else FAR_SIGMA * FAR_SIGMA
    J = np.zeros((2, 6))
    for n in range(len(uv)):
        p = p_w[n]
        X = T_c_w[0, 0] * p[0] + T_c_w[0, 1] * p[1] + T_c_w[0, 2] * p[2] + T_c_w[0, 3]
        Y = T_c_w[1, 0] * p[0] + T_c_w[1, 1] * p[1] + T_c_w[1, 2] * p[2] + T_c_w[1, 3]
        Z = T_c_w[2, 0] * p[0] + T_c_w[2, 1] * p[1] + T_c_w[2, 2] * p[2] + T_c_w[2, 3]
        if not min_depth < Z:
            cost += far if use[n] else 0.0
            continue
        iz = 1.0 / Z
        x, y = X * iz, Y * iz
        a, b = fx * inv_sigma[n], fy * inv_sigma[n]
        r, s = a * x + (cx - uv[n, 0]) * inv_sigma[n], b * y + (cy - uv[n, 1]) * inv_sigma[n]
        # Whitened by the inverse root of I + l l^T, which shortens components along l.
        u, v = slack[n, 0] * inv_sigma[n], slack[n, 1] * inv_sigma[n]
        length2 = u * u + v * v
        shorter = (1.0 - 1.0 / math.sqrt(1.0 + length2)) / length2 if length2 > 0.0 else 0.0
        along = (r * u + s * v) * shorter
        r, s = r - along * u, s - along * v
        square = r * r + s * s
        chi2[n] = square
        if not use[n]:
            continue
        weight = 1.0
        if robust and square > limit:
            norm = math.sqrt(square)
            weight = delta / norm
            cost += 2.0 * delta * norm - limit
        else:
            cost += square
        J[0, 0], J[0, 1], J[0, 2] = a * iz, 0.0, -a * x * iz
        J[0, 3], J[0, 4], J[0, 5] = -a * x * y, a * (1.0 + x * x), -a * y
        J[1, 0], J[1, 1], J[1, 2] = 0.0, b * iz, -b * y * iz
        J[1, 3], J[1, 4], J[1, 5] = -b * (1.0 + y * y), b * x * y, b * x
        for i in range(6):
            along = (J[0, i] * u + J[1, i] * v) * shorter
            J[0, i] -= along * u
            J[1, i] -= along * v
        for i in range(6):
            g[i] += weight * (J[0, i] * r + J[1, i] * s)
            for j in range(6):
                H[i, j] += weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
    return H, g, cost, chi2
