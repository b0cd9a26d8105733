r"""The relative visual measurement of two poses in the filter's state, in scalar code.

.. math:: T_{clone,b} = T_c^{-1} T, \quad h_t = R_c^T (p - p_c), \quad h_R = R_c^T R

Euler rates act in body axes through :math:`W = R^T E` (ZYX), which has a closed form. Scalar code avoids the overhead
of numpy calls, each of which costs as much as forty multiplications.
"""

import math

import numpy as np

from edgeslam_torch.geometry.rotations import rotation_vector_of
from edgeslam_torch.types import FloatArray

Row = tuple[float, float, float]
_sin, _cos = math.sin, math.cos


def relative_measurement(x: FloatArray, T_clone_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Innovation and its derivative.

    Args:
        x: State ``(15,)``: position, roll-pitch-yaw, velocity bias, cloned position, cloned roll-pitch-yaw.
        T_clone_b: Measured body pose in the cloned body frame ``(4, 4)`` [m].

    Returns:
        Measured minus predicted translation [m] and rotation vector [rad] ``(6,)``, and the derivative of the
        prediction by the state ``(6, 15)``.
    """
    px, py, pz, roll, pitch, yaw, _, _, _, qx, qy, qz, roll_c, pitch_c, yaw_c = x.tolist()
    a, b, c = _columns(roll_c, pitch_c, yaw_c)  # columns of R_c, rows of its transpose
    u, v, w = _columns(roll, pitch, yaw)
    step = (px - qx, py - qy, pz - qz)
    d0, d1, d2 = _dot(a, step), _dot(b, step), _dot(c, step)
    R = (
        (_dot(a, u), _dot(a, v), _dot(a, w)),
        (_dot(b, u), _dot(b, v), _dot(b, w)),
        (_dot(c, u), _dot(c, v), _dot(c, w)),
    )
    # W_c = R_c^T E_c, column k the body rate of Euler angle k; the first column is (1, 0, 0).
    sr, cr, sp, cp = _sin(roll_c), _cos(roll_c), _sin(pitch_c), _cos(pitch_c)
    y0, y1, y2 = -sp, sr * cp, cr * cp
    # R_c^T E = R_c^T R W.
    ts, tc = _sin(roll), _cos(roll)
    ps, pc = _sin(pitch), _cos(pitch)
    t = [(r0, tc * r1 - ts * r2, -ps * r0 + ts * pc * r1 + tc * pc * r2) for r0, r1, r2 in R]
    H = np.array(
        [
            *(*a, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -a[0], -a[1], -a[2], 0.0, -(cr * d2 + sr * d1), y2 * d1 - y1 * d2),
            *(*b, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -b[0], -b[1], -b[2], d2, sr * d0, y0 * d2 - y2 * d0),
            *(*c, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -c[0], -c[1], -c[2], -d1, cr * d0, y1 * d0 - y0 * d1),
            *(0.0, 0.0, 0.0, *t[0], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, -y0),
            *(0.0, 0.0, 0.0, *t[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -cr, -y1),
            *(0.0, 0.0, 0.0, *t[2], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, sr, -y2),
        ]
    ).reshape(6, 15)
    (m0, m1, m2, m3), (n0, n1, n2, n3), (o0, o1, o2, o3) = T_clone_b[:3].tolist()
    m, n, o = (m0, m1, m2), (n0, n1, n2), (o0, o1, o2)
    turned = [[_dot(row, r) for r in R] for row in (m, n, o)]  # measured times predicted transposed
    return np.array([m3 - d0, n3 - d1, o3 - d2, *rotation_vector_of(turned)]), H


def _dot(a: Row, b: Row) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _columns(roll: float, pitch: float, yaw: float) -> tuple[Row, Row, Row]:
    """Columns of ``Rz(yaw) Ry(pitch) Rx(roll)``."""
    cr, sr, cp, sp, cy, sy = _cos(roll), _sin(roll), _cos(pitch), _sin(pitch), _cos(yaw), _sin(yaw)
    return (
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    )
