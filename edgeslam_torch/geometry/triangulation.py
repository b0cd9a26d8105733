"""Points from two views, paper eq. (6): linear triangulation and parallax."""

import numpy as np

from edgeslam_torch.types import FloatArray


def bearings(uv: FloatArray, K: FloatArray) -> FloatArray:
    """Rays ``(N, 3)`` with ``z = 1`` in the camera frame of undistorted pixels ``(N, 2)``."""
    x = (uv[:, 0] - K[0, 2]) / K[0, 0]
    y = (uv[:, 1] - K[1, 2]) / K[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=1).astype(np.float64)


def triangulate(ray_i: FloatArray, ray_j: FloatArray, T_j_i: FloatArray) -> FloatArray:
    """Points ``(N, 3)`` in camera i from rays ``(N, 3)`` (z = 1) in both cameras.

    Least squares of the two depths along their rays (mid-point method, Hartley and Zisserman 2004, 12.2), which
    needs no SVD per point. Points of parallel rays are NaN. ``T_j_i`` may be ``(4, 4)`` or ``(N, 4, 4)``.
    """
    R, t = T_j_i[..., :3, :3], T_j_i[..., :3, 3]
    a = (R @ ray_i[..., None])[..., 0]  # d_i * a + t = d_j * b
    b = ray_j
    aa, bb, ab = (a * a).sum(-1), (b * b).sum(-1), (a * b).sum(-1)
    at, bt = (a * t).sum(-1), (b * t).sum(-1)
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        d_i = (ab * bt - bb * at) / determinant
        d_j = (aa * bt - ab * at) / determinant
        middle = 0.5 * (d_i[..., None] * a + d_j[..., None] * b + t)  # in camera j, between the two rays
    return ((middle - t)[..., None, :] @ R)[..., 0, :]


def parallax(ray_i: FloatArray, ray_j: FloatArray, R_j_i: FloatArray) -> FloatArray:
    """Angle [rad] between matched rays after removing the rotation, shape ``(N,)``."""
    a = (R_j_i @ ray_i[..., None])[..., 0]
    sine = np.linalg.norm(np.cross(a, ray_j), axis=-1)
    return np.arctan2(sine, (a * ray_j).sum(-1))
