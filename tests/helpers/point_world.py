"""A tiny noise-free world of points for solver tests."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class PointWorld:
    """Points on the walls of a box, seen by a few cameras, without noise."""

    T_c_w: FloatArray
    """``(W, 4, 4)`` world to camera."""
    p_w: FloatArray
    """``(N, 3)`` points [m]."""
    uv: FloatArray
    """``(W, N, 2)`` exact projections [px], also outside the image."""
    visible: np.ndarray
    """``(W, N)`` in front of the camera and inside the image, bool."""
    K: FloatArray
    """``(3, 3)`` calibration matrix [px]."""


def box_room(rng, n_points, dtype=np.float64, *, n_views=5):
    """Points on floor, ceiling and walls of a 4 x 4 x 2.6 m room, and ``n_views`` cameras that face its +x wall.

    The cameras stand 0.5 m or more apart and see (in front of them) every point: all lie at x >= 0.8 m while the
    cameras stay at x <= 0.
    """
    face = rng.integers(0, 5, n_points)  # +x wall, +y wall, -y wall, floor, ceiling
    low, high = np.array([0.8, -2.0, 0.0]), np.array([4.0, 2.0, 2.6])
    p_w = rng.uniform(low, high, (n_points, 3))
    for k, (axis, value) in enumerate([(0, 4.0), (1, 2.0), (1, -2.0), (2, 0.0), (2, 2.6)]):
        p_w[face == k, axis] = value
    K = np.array([[320.0, 0.0, 319.5], [0.0, 320.0, 239.5], [0.0, 0.0, 1.0]])
    R_w_c = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along +x
    T_c_w = np.empty((n_views, 4, 4))
    for i in range(n_views):
        T_w_c = np.eye(4)
        T_w_c[:3, :3] = se3.exp(np.r_[np.zeros(3), rng.normal(0.0, 0.08, 3)])[:3, :3] @ R_w_c
        side = -1.2 + 2.4 * i / max(n_views - 1, 1)
        T_w_c[:3, 3] = [rng.uniform(-0.6, 0.0), side, 1.3 + rng.uniform(-0.4, 0.4)]
        T_c_w[i] = se3.inverse(T_w_c)
    p_c = np.einsum("wij,nj->wni", T_c_w[:, :3, :3], p_w) + T_c_w[:, None, :3, 3]
    uvw = p_c @ K.T
    uv = uvw[..., :2] / uvw[..., 2:]
    visible = (p_c[..., 2] > 0.05) & (uv >= -0.5).all(-1) & (uv < np.array([639.5, 479.5])).all(-1)
    return PointWorld(T_c_w.astype(dtype), p_w.astype(dtype), uv.astype(dtype), visible, K.astype(dtype))
