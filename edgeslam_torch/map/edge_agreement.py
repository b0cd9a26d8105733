"""Consistency of edge depths between keyframes that observe the same edges."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, IntArray

AGREE_PX = 2.0
"""Maximum distance of a projected edge point from the same edge in another keyframe."""
DEFAULT_BEND = 0.015
"""Typical relative bend of the map, used if too few keyframes overlap; empirical."""
SHARED = 1.7
"""Ratio of the depth error to the disagreement of overlapping keyframes, which share part of their error. With this
factor 5 % of the points of simulated places are beyond two sigmas, as of a normal distribution."""
_GAP = 3
"""Minimum number of keyframes between two that are compared; nearer ones are refined in the same windows."""
_PAIRS, _LEAST_PAIRS = 200, 10
_POINTS, _LEAST_POINTS = 400, 40
"""Number of edges searched in the other keyframe, and minimum number found."""
_MOST_TURNED = math.cos(math.radians(40.0))
"""Cosine of the maximum angle between views that show the same sides of objects."""

_REACH = math.ceil(AGREE_PX + 0.5)
"""Radius [px] of a painted edge: a query may be rounded by half a pixel."""


@dataclass(frozen=True, slots=True)
class View:
    """Measured edges of a keyframe."""

    T_w_c: FloatArray
    uv: FloatArray
    """``(E, 2)``"""
    p_c: FloatArray
    """``(E, 3)`` in the camera."""


def bend(views: list[View], camera: Camera) -> float:
    """Relative standard deviation of depth that the edges' own sigmas do not have: the bend of the map.

    Depths of common edges in distant keyframes differ by the drift between these. The estimate is the median over pairs
    of keyframes of their median difference, which is robust to mismatched edges.
    """
    found = []
    painted, drawn = None, -1
    for a, b in sorted(_pairs(views)):  # one painted view at a time, which has as many pixels as the image
        if painted is None or drawn != a:
            painted, drawn = PaintedEdges.of(views[a].uv, (camera.width, camera.height)), a
        off = _disagreement(views[a], painted, views[b], camera)
        if off is not None:
            found.append(abs(off))
    if len(found) < _LEAST_PAIRS:
        return DEFAULT_BEND
    # Of a normal distribution the median is 0.67 sigma; two depths are compared.
    return SHARED * float(np.median(found)) / 0.6745 / math.sqrt(2.0)


def _pairs(views: list[View]) -> list[tuple[int, int]]:
    """At most `_PAIRS` random ordered pairs of distant keyframes with similar viewing directions."""
    ahead = np.array([v.T_w_c[:3, 2] for v in views]).reshape(-1, 3)
    a, b = np.nonzero(ahead @ ahead.T > _MOST_TURNED)
    known = np.array([len(v.uv) >= _LEAST_POINTS for v in views], dtype=bool)
    a, b = np.stack([a, b])[:, (np.abs(a - b) >= _GAP) & known[a] & known[b]]
    some = np.random.default_rng(0).permutation(len(a))[:_PAIRS]
    return list(zip(a[some].tolist(), b[some].tolist(), strict=True))


def _disagreement(one: View, painted: "PaintedEdges", other: View, camera: Camera) -> float | None:
    """Median log ratio of the depths of the edges that both show; None for too few."""
    some = slice(None, None, max(1, len(other.p_c) // _POINTS))
    p = se3.transform(se3.inverse(one.T_w_c) @ other.T_w_c, other.p_c[some])
    p = p[p[:, 2] > 0]
    mine = painted.nearest(camera.project(p))
    seen = mine >= 0
    if int(seen.sum()) < _LEAST_POINTS:
        return None
    return float(np.median(np.log(p[seen, 2] / one.p_c[mine[seen], 2])))


@dataclass(frozen=True, slots=True)
class PaintedEdges:
    """Edge pixels rendered into an index image: a third of the time to build and query a tree."""

    uv: FloatArray
    """``(E, 2)``"""
    index: IntArray
    """``(H + 2 R, W + 2 R)`` edge within `AGREE_PX` of each pixel, or a little more, -1 where there is none."""

    @classmethod
    def of(cls, uv: FloatArray, size: tuple[int, int]) -> "PaintedEdges":
        """Paint edge pixels ``(E, 2)`` of an image of ``size`` (width, height), the nearest last."""
        width, height = (n + 2 * _REACH for n in size)
        index = np.full(width * height, -1, dtype=np.int32)
        u, v = np.rint(uv).astype(np.int64).T + _REACH
        flat, order = v * width + u, np.arange(len(uv), dtype=np.int32)
        for offset in _disc(_REACH, width):
            index[flat + offset] = order
        return cls(uv, index.reshape(height, width))

    def nearest(self, uv: FloatArray) -> IntArray:
        """Index of the edge pixel nearest to each of ``(N, 2)``, -1 where none is within `AGREE_PX`.

        Queries are rounded to pixels, so that of two edges at nearly the same distance either may be returned.
        """
        height, width = self.index.shape
        u, v = (uv + (_REACH + 0.5)).T  # half a pixel more, so that cutting off rounds
        inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < width) & (v < height))
        near = self.index[v[inside].astype(np.intp), u[inside].astype(np.intp)]
        some = np.flatnonzero(near >= 0)
        query, edge = inside[some], near[some]
        offset = self.uv[edge] - uv[query]
        close = np.einsum("ij,ij->i", offset, offset) <= AGREE_PX**2
        found = np.full(len(uv), -1, dtype=np.int64)
        found[query[close]] = edge[close]
        return found


def _disc(radius: int, width: int) -> list[int]:
    """Offsets of the pixels of a disc in a flat image, the farthest from its middle first."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    distance = (u * u + v * v).ravel()
    order = np.argsort(-distance, kind="stable")
    return [int(o) for o in (v * width + u).ravel()[order[distance[order] <= radius * radius]]]
