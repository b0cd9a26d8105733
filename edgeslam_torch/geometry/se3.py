"""Rigid motions as ``(4, 4)`` matrices in numpy float64; tangents ``xi = (rho, phi)``, applied on the left.

Same order as kornia. These functions serve the per-frame path, where a numpy call costs a tenth
of a torch call and ten operations on Python floats cost one numpy call.
"""

import math

import numpy as np

from edgeslam_torch.types import FloatArray


def hat(phi: FloatArray) -> FloatArray:
    """Cross-product matrix ``(..., 3, 3)`` of ``(..., 3)``.

    Example:
        >>> hat(np.array([1.0, 2.0, 3.0])) @ np.array([0.0, 0.0, 1.0])
        array([ 2., -1.,  0.])
    """
    phi = np.asarray(phi, dtype=np.float64)
    x, y, z = phi[..., 0], phi[..., 1], phi[..., 2]
    out = np.zeros((*phi.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def exp(xi: FloatArray) -> FloatArray:
    """Rigid motion ``(4, 4)`` of a tangent ``(6,)`` (Barfoot 2017, eq. 7.86)."""
    u, v, w, x, y, z = (float(value) for value in xi)
    theta2 = x * x + y * y + z * z
    theta = math.sqrt(theta2)
    if theta < 1e-3:  # Taylor terms, as 1 - cos cancels; the next ones are below float64 resolution
        a = 1.0 - theta2 / 6.0 + theta2 * theta2 / 120.0
        b = 0.5 - theta2 / 24.0 + theta2 * theta2 / 720.0
        c = 1.0 / 6.0 - theta2 / 120.0 + theta2 * theta2 / 5040.0
    else:
        a = math.sin(theta) / theta
        b = (1.0 - math.cos(theta)) / theta2
        c = (theta - math.sin(theta)) / (theta * theta2)
    # hat(phi) rho, and hat(phi)^2 as phi phi^T - theta^2 I.
    p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
    along = c * (x * u + y * v + z * w)
    rest = 1.0 - c * theta2
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y, rest * u + b * p + along * x],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x, rest * v + b * q + along * y],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y), rest * w + b * r + along * z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def log(T: FloatArray) -> FloatArray:
    """Tangent ``(6,)`` of a rigid motion ``(4, 4)``; inverse of `exp` for angles below pi."""
    i, j, k, real = quaternion(T)
    sine = math.sqrt(i * i + j * j + k * k)
    theta = 2.0 * math.atan2(sine, real)
    turn = theta / sine if sine > 1e-9 else 2.0
    x, y, z = turn * i, turn * j, turn * k
    half = 0.5 * theta
    c = 1.0 / 12.0 if theta < 1e-4 else (1.0 - half / math.tan(half)) / theta**2
    u, v, w = (float(value) for value in T[:3, 3])
    p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
    along = c * (x * u + y * v + z * w)
    rest = 1.0 - c * theta**2
    return np.array(
        [rest * u - 0.5 * p + along * x, rest * v - 0.5 * q + along * y, rest * w - 0.5 * r + along * z, x, y, z]
    )


def inverse(T: FloatArray) -> FloatArray:
    """Inverse of rigid motions ``(..., 4, 4)``."""
    out = np.zeros_like(T)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: FloatArray) -> FloatArray:
    """``(..., 6, 6)`` with ``T exp(xi) T^-1 = exp(adjoint(T) xi)`` for rigid motions ``(..., 4, 4)``."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out


def transform(T: FloatArray, p: FloatArray) -> FloatArray:
    """Points ``(N, 3)`` transformed by ``T`` ``(4, 4)``."""
    return p @ T[:3, :3].T + T[:3, 3]


def scaled(T: FloatArray, scale: float) -> FloatArray:
    """The same motion ``(4, 4)`` in units that are ``scale`` times smaller."""
    out = T.copy()
    out[:3, 3] *= scale
    return out


def orthonormalised(T: FloatArray) -> FloatArray:
    """``T`` with its rotation projected to the nearest orthonormal matrix; long products drift without it."""
    out = T.copy()
    U, _, V_t = np.linalg.svd(T[:3, :3])
    out[:3, :3] = U @ V_t
    return out


def quaternion(T: FloatArray) -> tuple[float, float, float, float]:
    """Unit ``(x, y, z, w)`` of the rotation in ``T`` ``(4, 4)`` or ``(3, 3)``, with ``w >= 0``."""
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    # Four times the squares of w, x, y, z; the largest is divided by (Shepperd 1978).
    squares = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    largest = squares.index(max(squares))
    if largest == 0:
        w, x, y, z = squares[0], h - f, c - g, d - b
    elif largest == 1:
        w, x, y, z = h - f, squares[1], b + d, c + g
    elif largest == 2:
        w, x, y, z = c - g, b + d, squares[2], f + h
    else:
        w, x, y, z = d - b, c + g, f + h, squares[3]
    scale = math.copysign(1.0 / math.sqrt(w * w + x * x + y * y + z * z), w)
    return scale * x, scale * y, scale * z, scale * w


def pose_to_tum(T: FloatArray) -> FloatArray:
    """``tx ty tz qx qy qz qw`` with ``qw >= 0``, shape ``(7,)``."""
    return np.array([*T[:3, 3].tolist(), *quaternion(T)])
