"""Map points in front of a depth map, such as a table edge that the network missed.

A depth network often predicts the wall behind a textureless or thin object, whose edges the map has triangulated. Where
both depths are known, the nearer one counts.
"""

import numpy as np

from edgeslam_torch.types import DepthMap, FloatArray

SIGMA_LOG = 0.05
"""Standard deviation of log depth of map points."""
MIN_AGREEING = 3
"""Points that must agree to count as an obstacle; single ones are mostly outliers."""
MIN_DEPTH = 0.1
"""Minimum depth of a point [m]."""
_CELL_SHARE = 0.02
"""Cell size in shares of the image width: 1.6 degrees of a Tello's camera."""
_CELL_LOG = 0.12
"""Cell size in log depth."""


def seen_points(
    p_w: FloatArray, K: FloatArray, T_w_c: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(N, 2)`` and depths ``(N,)`` of points ``(M, 3)`` inside an image ``(H, W)`` taken at ``T_w_c``."""
    p_c = (p_w - T_w_c[:3, 3]) @ T_w_c[:3, :3]
    p_c = p_c[p_c[:, 2] > MIN_DEPTH]
    uv = (p_c[:, :2] / p_c[:, 2:]) * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    inside = ((uv > -0.5) & (uv < [shape[1] - 0.5, shape[0] - 0.5])).all(axis=1)
    return uv[inside], p_c[inside, 2]


def agreeing(uv: FloatArray, z: FloatArray, width: int) -> np.ndarray:
    """Indices of points that share a cell of pixels and depth with at least `MIN_AGREEING` points.

    Two grids, shifted by half a cell, so that no cell border splits a group.

    Args:
        uv: ``(N, 2)`` pixels.
        z: ``(N,)`` depths.
        width: Image width [px].
    """
    together = np.zeros(len(z), dtype=bool)
    for shift in (0.0, 0.5):
        cell = np.floor(np.column_stack([uv / (_CELL_SHARE * width), np.log(z) / _CELL_LOG]) + shift).astype(np.int64)
        cell -= cell.min(axis=0, initial=0)
        extent = cell.max(axis=0, initial=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, group, count = np.unique(key, return_inverse=True, return_counts=True)
        together |= count[group] >= MIN_AGREEING
    return np.flatnonzero(together)


def with_nearer_points(depth: DepthMap, uv: FloatArray, z: FloatArray) -> DepthMap:
    """Depth map with the points' depth where it is nearer or the depth map is unknown.

    Args:
        depth: In the unit of the points.
        uv: ``(N, 2)`` pixels inside the image.
        z: ``(N,)`` depths.
    """
    u, v = np.rint(uv).astype(int).clip(0, np.array(depth.depth_m.shape[::-1]) - 1).T
    points = np.full(depth.depth_m.shape, np.inf, np.float32)
    np.minimum.at(points, (v, u), z.astype(np.float32))
    known = np.isfinite(depth.depth_m) & (depth.depth_m > 0)
    nearer = np.isfinite(points) & (~known | (points < depth.depth_m))
    return DepthMap(
        np.where(nearer, points, depth.depth_m),
        np.where(nearer, np.float32(SIGMA_LOG), depth.sigma_log).astype(np.float32),
    )
