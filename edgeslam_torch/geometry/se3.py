"""Rigid motions as ``(4, 4)`` matrices in numpy float64; tangents ``xi = (rho, phi)``, applied on the left.

The torch solver uses the same order (kornia's); these few functions serve the per-frame path, where a numpy call
costs a tenth of a torch call.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.types import FloatArray


def hat(phi: FloatArray) -> FloatArray:
    """Cross-product matrix ``(..., 3, 3)`` of ``(..., 3)``.

    Example:
        >>> hat(np.array([1.0, 2.0, 3.0])) @ np.array([0.0, 0.0, 1.0])
        array([ 2., -1.,  0.])
    """
    x, y, z = np.moveaxis(np.asarray(phi, dtype=np.float64), -1, 0)
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*np.shape(x), 3, 3)


def exp(xi: FloatArray) -> FloatArray:
    """Rigid motion ``(4, 4)`` of a tangent ``(6,)`` (Barfoot 2017, eq. 7.86)."""
    rho, phi = np.asarray(xi[:3], dtype=np.float64), np.asarray(xi[3:], dtype=np.float64)
    theta = float(np.linalg.norm(phi))
    W = hat(phi)
    if theta < 1e-6:  # Taylor terms; the next one is below float64 resolution
        a, b, c = 1.0 - theta**2 / 6.0, 0.5 - theta**2 / 24.0, 1.0 / 6.0 - theta**2 / 120.0
    else:
        a = np.sin(theta) / theta
        b = (1.0 - np.cos(theta)) / theta**2
        c = (theta - np.sin(theta)) / theta**3
    T = np.eye(4)
    WW = W @ W
    T[:3, :3] += a * W + b * WW
    T[:3, 3] = rho + b * (W @ rho) + c * (WW @ rho)
    return T


def log(T: FloatArray) -> FloatArray:
    """Tangent ``(6,)`` of a rigid motion ``(4, 4)``; inverse of `exp` for angles below pi."""
    phi = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    theta = float(np.linalg.norm(phi))
    W = hat(phi)
    half = 0.5 * theta
    c = 1.0 / 12.0 if theta < 1e-4 else (1.0 - half / np.tan(half)) / theta**2
    rho = T[:3, 3] - 0.5 * (W @ T[:3, 3]) + c * (W @ (W @ T[:3, 3]))
    return np.concatenate([rho, phi])


def inverse(T: FloatArray) -> FloatArray:
    """Inverse of rigid motions ``(..., 4, 4)``."""
    out = np.zeros_like(T)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(T: FloatArray, p: FloatArray) -> FloatArray:
    """Points ``(N, 3)`` moved by ``T`` ``(4, 4)``."""
    return p @ T[:3, :3].T + T[:3, 3]


def orthonormalised(T: FloatArray) -> FloatArray:
    """``T`` with its rotation projected to the nearest orthonormal one; long products drift without it."""
    out = T.copy()
    out[:3, :3] = Rotation.from_matrix(T[:3, :3]).as_matrix()
    return out


def pose_from_tum(row: FloatArray) -> FloatArray:
    """``(4, 4)`` from ``tx ty tz qx qy qz qw``."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(row[3:7]).as_matrix()
    T[:3, 3] = row[:3]
    return T


def pose_to_tum(T: FloatArray) -> FloatArray:
    """``tx ty tz qx qy qz qw`` with ``qw >= 0``, shape ``(7,)``."""
    q = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return np.concatenate([T[:3, 3], q])
