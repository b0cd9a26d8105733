"""Roll, pitch, yaw and rotation vectors in scalar code: the filter processes single poses, where numpy is slow."""

import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.types import FloatArray


def matrix_from_rpy(rpy: FloatArray) -> FloatArray:
    """Rotation ``(3, 3)``, ``Rz(yaw) Ry(pitch) Rx(roll)``, body to world."""
    roll, pitch, yaw = float(rpy[0]), float(rpy[1]), float(rpy[2])
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll),
        math.sin(roll),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(yaw),
        math.sin(yaw),
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrices_from_rpy(rpy: FloatArray) -> FloatArray:
    """The same of many ``(N, 3)``, shape ``(N, 3, 3)``."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy).T, np.sin(rpy).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def rpy_from_matrix(R: FloatArray) -> FloatArray:
    """``(roll, pitch, yaw)`` [rad] of a rotation ``(3, 3)``; at a pitch of 90 degrees yaw and roll are ambiguous."""
    pitch = math.asin(max(-1.0, min(1.0, -float(R[2, 0]))))
    roll = math.atan2(float(R[2, 1]), float(R[2, 2]))
    yaw = math.atan2(float(R[1, 0]), float(R[0, 0]))
    return np.array([roll, pitch, yaw])


def euler_rate_matrix(rpy: FloatArray) -> FloatArray:
    """``(3, 3)`` matrix that takes changes of (roll, pitch, yaw) to a small world-frame rotation vector."""
    pitch, yaw = float(rpy[1]), float(rpy[2])
    cp, sp, cy, sy = math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    return np.array([[cy * cp, -sy, 0.0], [sy * cp, cy, 0.0], [-sp, 0.0, 1.0]])


def rotation_vector(R: FloatArray) -> FloatArray:
    """Rotation vector ``(3,)`` [rad] of ``R``, for angles below pi."""
    return np.array(rotation_vector_of(R.tolist()))


def rotation_vector_of(rows: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """The same for plain numbers."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    x, y, z = r21 - r12, r02 - r20, r10 - r01
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (r00 + r11 + r22 - 1.0))
    scale = 0.5 if sine < 1e-9 else 0.5 * angle / sine
    return scale * x, scale * y, scale * z


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    return (np.asarray(angle) + math.pi) % (2.0 * math.pi) - math.pi


def mean_rotation(R: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Chordal mean ``(3, 3)`` of rotations ``(N, 3, 3)`` (Hartley et al. 2013, section 5.3)."""
    M = np.tensordot(np.ones(len(R)) if weights is None else weights, R, axes=1)
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))]) @ Vt
