"""Radius search over keypoints in a grid of cells, since keypoints are spread evenly and radii are small.

Every query has its own radius: a k-d tree's pair search uses one for all, which a single anchor of the coarsest pyramid
level makes three times too wide.
"""

import math

import numpy as np

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

CELL_PX = 16.0
"""Side of a cell; the fastest of 8, 12, 16, 24 and 32 for a thousand keypoints in 640x480."""


class KeypointGrid:
    """Keypoints ``(N, 2)`` [px] sorted by cell, row by row; immutable."""

    __slots__ = ("_columns", "_order", "_origin", "_rows", "_start", "_u", "_v")

    def __init__(self, uv: FloatArray) -> None:
        uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
        self._origin = uv.min(axis=0) if len(uv) else np.zeros(2)
        cell = ((uv - self._origin) / CELL_PX).astype(np.int64)
        self._columns, self._rows = (int(n) for n in cell.max(axis=0, initial=0) + 1)
        flat = cell[:, 1] * self._columns + cell[:, 0]
        self._order = np.argsort(flat, kind="stable")
        self._start = np.searchsorted(flat[self._order], np.arange(self._rows * self._columns + 1))
        self._u, self._v = uv[self._order].T.copy()

    def __len__(self) -> int:
        return len(self._order)

    def near(self, query_uv: FloatArray, radius_px: FloatArray) -> tuple[IntArray, IntArray]:
        """All pairs (query, keypoint) within each query's own radius, as two index arrays.

        Args:
            query_uv: Pixels ``(M, 2)``, finite, inside the image or not.
            radius_px: ``(M,)``.

        Example:
            >>> grid = KeypointGrid(np.array([[10.0, 10.0], [100.0, 10.0]]))
            >>> grid.near(np.array([[98.0, 10.0], [50.0, 50.0]]), np.array([3.0, 3.0]))
            (array([0]), array([1]))
        """
        if len(query_uv) == 0 or len(self) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        query_uv, radius_px = np.asarray(query_uv, dtype=np.float64), np.asarray(radius_px, dtype=np.float64)
        return _near(query_uv, radius_px, self._u, self._v, self._order, self._start, self._origin, self._columns)


def nearest_pixels(uv: FloatArray, query_uv: FloatArray, count: int) -> tuple[FloatArray, IntArray]:
    """Distances [px] and indices, ``(M, count)`` each, of the ``count`` pixels of ``(N, 2)`` nearest to ``(M, 2)``.

    Example:
        >>> nearest_pixels(np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([[8.0, 0.0]]), 1)
        (array([[1.]]), array([[1]]))
    """
    return _nearest(np.asarray(uv, np.float64), np.asarray(query_uv, np.float64), count)


@compiled("f8[:,::1], f8[:,::1], i8")
def _nearest(uv: FloatArray, query_uv: FloatArray, count: int) -> tuple[FloatArray, IntArray]:
    squared, index = np.full((len(query_uv), count), np.inf), np.zeros((len(query_uv), count), np.int64)
    for q in range(len(query_uv)):
        best, which = squared[q], index[q]
        x, y = query_uv[q]
        for k in range(len(uv)):
            away = (uv[k, 0] - x) ** 2 + (uv[k, 1] - y) ** 2
            if away < best[-1]:
                at = count - 1
                while at > 0 and away < best[at - 1]:
                    best[at], which[at] = best[at - 1], which[at - 1]
                    at -= 1
                best[at], which[at] = away, k
    return np.sqrt(squared), index


@compiled("f8[:,::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[::1], f8[::1], i8")
def _near(
    query_uv: FloatArray,
    radius_px: FloatArray,
    u: FloatArray,
    v: FloatArray,
    order: IntArray,
    start: IntArray,
    origin: FloatArray,
    columns: int,
) -> tuple[IntArray, IntArray]:
    """Pairs of queries and keypoints; the keypoints sorted by cell, of which ``start`` holds the first of each."""
    rows = (len(start) - 1) // columns
    query, keypoint = np.empty(4 * len(query_uv), np.int64), np.empty(4 * len(query_uv), np.int64)
    found = 0
    for q in range(len(query_uv)):
        x, y, r = query_uv[q, 0], query_uv[q, 1], radius_px[q]
        left = int(max(math.floor((x - r - origin[0]) / CELL_PX), 0.0))
        right = int(min(math.floor((x + r - origin[0]) / CELL_PX), columns - 1.0))
        top = int(max(math.floor((y - r - origin[1]) / CELL_PX), 0.0))
        bottom = int(min(math.floor((y + r - origin[1]) / CELL_PX), rows - 1.0))
        if left > right:
            continue
        for row in range(top, bottom + 1):
            # Keypoints of neighbouring cells in a row are contiguous.
            for k in range(start[row * columns + left], start[row * columns + right + 1]):
                if (u[k] - x) ** 2 + (v[k] - y) ** 2 <= r * r:
                    if found == len(query):
                        query, keypoint = np.append(query, np.empty_like(query)), np.append(keypoint, query)
                    query[found], keypoint[found] = q, order[k]
                    found += 1
    return query[:found], keypoint[:found]
