"""Points of the map that stand before what a depth map shows: a table's edge that the network looked through.

A network sees the wall behind a plain or thin thing; the edges of that thing are in the map, with the depth that
several views gave them. Where both are known, the nearer one counts for a drone.
"""

import numpy as np

from edgeslam_torch.types import DepthMap, FloatArray

SIGMA_LOG = 0.05
"""Of a depth that points of the map tell."""
MIN_AGREEING = 3
"""Points that must agree before they tell an obstacle: single ones are wrong more often than one is so small."""
MIN_DEPTH = 0.1
"""Points nearer to the camera are none [m]."""
_CELL_SHARE = 0.02
"""Side of the cells in which points agree, of the picture's width: 1.6 degrees of a Tello's."""
_CELL_LOG = 0.12
"""Their depth, in the logarithm."""


def seen_points(
    p_w: FloatArray, K: FloatArray, T_w_c: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(N, 2)`` and depths ``(N,)`` of points ``(M, 3)`` that a picture ``(H, W)`` from ``T_w_c`` shows."""
    p_c = (p_w - T_w_c[:3, 3]) @ T_w_c[:3, :3]
    p_c = p_c[p_c[:, 2] > MIN_DEPTH]
    uv = (p_c[:, :2] / p_c[:, 2:]) * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    inside = ((uv > -0.5) & (uv < [shape[1] - 0.5, shape[0] - 0.5])).all(axis=1)
    return uv[inside], p_c[inside, 2]


def agreeing(uv: FloatArray, z: FloatArray, width: int) -> np.ndarray:
    """Rows of the points that share a small part of a picture and a range of depths with `MIN_AGREEING` in all.

    Cells are laid twice, the second time by half a cell further, so that no border parts what is together.

    Args:
        uv: ``(N, 2)`` where points are seen [px].
        z: ``(N,)`` their depths.
        width: Of the picture [px].
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
    """A depth map that has the depth of points at the pixels at which these are nearer, or its own is unknown.

    Args:
        depth: In the unit of the points.
        uv: ``(N, 2)`` where points are seen [px], inside the picture.
        z: ``(N,)`` their depths.
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
