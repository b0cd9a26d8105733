"""Rotations: roll, pitch, yaw, rotation vectors and fits; in scalar code for single ones, where numpy is slow."""

import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.geometry.se3 import hat
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


def matrices_from_vectors(phi: FloatArray) -> FloatArray:
    """Rotations ``(..., 3, 3)`` of rotation vectors ``(..., 3)`` [rad] (Rodrigues)."""
    half = np.linalg.norm(phi, axis=-1)[..., None, None] / (2.0 * np.pi)  # in the unit of `numpy.sinc`
    across = hat(phi)
    return np.eye(3) + np.sinc(2.0 * half) * across + 0.5 * np.sinc(half) ** 2 * (across @ across)


def matrices_from_quaternions(q: FloatArray) -> FloatArray:
    """Rotations ``(N, 3, 3)`` of quaternions ``(N, 4)`` (x, y, z, w) of any length but zero."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def quaternions_from_matrices(R: FloatArray) -> FloatArray:
    """Unit quaternions ``(N, 4)`` (x, y, z, w), ``w >= 0``, of rotations ``(N, 3, 3)``."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, 0, -1)
    # Rows are the quaternion (w, x, y, z) times four of its components; the longest one is accurate (Shepperd 1978).
    rows = np.array(
        [
            [1.0 + a + e + i, h - f, c - g, d - b],
            [h - f, 1.0 + a - e - i, b + d, c + g],
            [c - g, b + d, 1.0 - a + e - i, f + h],
            [d - b, c + g, f + h, 1.0 - a - e + i],
        ]
    )
    wxyz = rows[np.einsum("iin->in", rows).argmax(axis=0), :, np.arange(len(a))]
    length = np.copysign(np.linalg.norm(wxyz, axis=1, keepdims=True), wxyz[:, :1])
    return np.asarray((wxyz / length)[:, [1, 2, 3, 0]])


def vectors_from_matrices(R: FloatArray) -> FloatArray:
    """Rotation vectors ``(..., 3)`` [rad] of rotations ``(..., 3, 3)``, accurate for angles up to pi."""
    *xyz, w = quaternions_from_matrices(R.reshape(-1, 3, 3)).T
    sine = np.linalg.norm(xyz, axis=0)
    small = sine < 1e-9
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, w) / np.where(small, 1.0, sine))
    return np.asarray((scale * np.array(xyz)).T.reshape(R.shape[:-1]))


def angles(R: FloatArray) -> FloatArray:
    """Angles ``(N,)`` [rad] of rotations ``(N, 3, 3)``, from 0 to pi."""
    return np.asarray(np.linalg.norm(vectors_from_matrices(R), axis=-1))


def rotated(R: FloatArray, p: FloatArray) -> FloatArray:
    """Vectors ``(N, 3)``, each by its own rotation ``(N, 3, 3)``."""
    return np.einsum("kij,kj->ki", R, p)


def smallest_rotation(a: FloatArray, b: FloatArray) -> FloatArray:
    """The rotation ``(3, 3)`` by the smallest angle that takes the direction ``a`` to the direction ``b``."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    half = a + b
    if half @ half < 1e-18:  # opposite: half a turn about any axis across
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return np.asarray(2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3))
    # Half a turn about `a`, then half a turn about the middle between both.
    return np.asarray((2.0 * np.outer(half, half) / (half @ half) - np.eye(3)) @ (2.0 * np.outer(a, a) - np.eye(3)))


def fitted_rotation(a: FloatArray, b: FloatArray) -> FloatArray:
    """The rotation ``(3, 3)`` that takes vectors ``a`` to ``b``, ``(N, 3)`` each, with the least error (Wahba)."""
    return nearest_rotation(b.T @ a)


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Rotations ``(..., 3, 3)`` nearest to matrices ``(..., 3, 3)`` in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    return (np.asarray(angle) + math.pi) % (2.0 * math.pi) - math.pi


def mean_rotation(R: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Chordal mean ``(3, 3)`` of rotations ``(N, 3, 3)`` (Hartley et al. 2013, section 5.3)."""
    return nearest_rotation(np.tensordot(np.ones(len(R)) if weights is None else weights, R, axes=1))
