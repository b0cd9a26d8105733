"""Association of edge pixels with the nearest edge of another keyframe that has the same direction."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.compiled import compiled
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import Edges, FloatArray, IntArray

MAX_TURN_RAD = 0.44
"""Maximum angle (25 degrees) between predicted and observed normal."""

MAX_DEPTH_RATIO = 1.35
"""Maximum ratio between the predicted and the observed depth."""

PX_PER_TURN = 9.0
"""Weight of the angle between normals in the nearest-neighbour search [px/rad]: 25 degrees count as 4 px."""

_CELL_PX = 8.0
"""Side of a cell of the search grid."""


@dataclass(frozen=True, slots=True)
class EdgeField:
    """Edge pixels of a keyframe, sorted into a grid of cells, row by row."""

    edges: Edges
    inverse_depth: FloatArray
    """``(E,)`` inverse depths of its edges [1/m]; zero where unknown."""
    size: tuple[int, int]
    """Width and height of the image [px]."""
    order: IntArray
    """``(E,)`` edges by cell."""
    start: IntArray
    """Where each cell begins in ``order``, and the end."""


def edge_field(edges: Edges, inverse_depth: FloatArray, size: tuple[int, int]) -> EdgeField:
    """Index a keyframe's edges.

    Args:
        edges: Edge pixels with their normals.
        inverse_depth: ``(E,)`` [1/m], zero where unknown.
        size: Width and height [px].
    """
    columns, rows = (int(side / _CELL_PX) + 1 for side in size)
    u, v = np.clip((edges.uv / _CELL_PX).astype(np.int64), 0, (columns - 1, rows - 1)).T
    cell = v * columns + u
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    return EdgeField(edges, np.asarray(inverse_depth, np.float64), size, order, start)


def nearest_edges(field: EdgeField, uv: FloatArray, normal: FloatArray, reach_px: float) -> IntArray:
    """Indices ``(N,)`` of the edge pixels nearest to pixels ``(N, 2)`` in position and direction.

    Args:
        field: Edges.
        uv: Pixels.
        normal: Their unit normals ``(N, 2)``.
        reach_px: Distance, direction included by `PX_PER_TURN`, beyond which the index is -1.
    """
    edges, uv, normal = field.edges, np.asarray(uv, np.float64), np.asarray(normal, np.float64)
    return _nearest_edges(uv, normal, edges.uv, edges.normal, field.order, field.start, field.size, reach_px)


@dataclass(frozen=True, slots=True)
class EdgePairs:
    """Pairs of an edge pixel and its partner in another pose; fields as `EdgeTerms` takes them."""

    pair_edge: IntArray
    pair_pose: IntArray
    pair_uv: FloatArray
    pair_normal: FloatArray
    pair_inverse_depth: FloatArray


def associate_edges(
    fields: Sequence[EdgeField | None],
    T_c_w: FloatArray,
    host: IntArray,
    uv: FloatArray,
    normal: FloatArray,
    inverse_depth: FloatArray,
    pair_edge: IntArray,
    pair_pose: IntArray,
    K: tuple[float, float, float, float],
    max_px: float = 4.0,
) -> EdgePairs:
    """Partners of edge pixels in their target poses.

    A pair is kept if the projected pixel lies in the image, the partner is near, has the same direction and polarity
    (bright side), and its depth, where known, agrees.

    Args:
        fields: One per pose; None for a pose that is no target.
        T_c_w: World-to-camera poses ``(W, 4, 4)``.
        host: ``(E,)`` pose of each edge pixel.
        uv: ``(E, 2)`` edge pixels.
        normal: ``(E, 2)`` their unit normals.
        inverse_depth: ``(E,)`` [1/m].
        pair_edge: ``(P,)`` candidate pairs: edge.
        pair_pose: ``(P,)`` candidate pairs: target pose.
        K: fx, fy, cx, cy [px].
        max_px: Maximum distance to the partner.
    """
    parts = []
    order = np.argsort(pair_pose, kind="stable")
    poses, first = np.unique(np.asarray(pair_pose)[order], return_index=True)
    T_w_c = se3.inverse(T_c_w)
    uv, normal, inverse_depth = (np.asarray(x, np.float64) for x in (uv, normal, inverse_depth))
    for pose, mine in zip(poses, np.split(order, first[1:]), strict=False):  # without pairs there is one empty group
        field = fields[pose]
        if field is None or len(field.edges.uv) == 0:
            continue
        edge, to = np.asarray(pair_edge)[mine], field.edges
        grid = (to.uv, to.normal, field.inverse_depth, field.order, field.start, field.size)
        partner = _partners(T_c_w[pose] @ T_w_c, host, edge, uv, normal, inverse_depth, *grid, K, max_px)
        found = partner >= 0
        edge, partner = edge[found], partner[found]
        target = np.full(len(edge), pose, dtype=np.int64)
        seen = to.uv[partner].astype(np.float64), to.normal[partner].astype(np.float64)
        parts.append((edge, target, *seen, field.inverse_depth[partner]))
    if not parts:
        none, two = np.zeros(0), np.zeros((0, 2))
        return EdgePairs(np.zeros(0, np.int64), np.zeros(0, np.int64), two, two, none)
    return EdgePairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@compiled()
def _nearest(
    x: float,
    y: float,
    normal_x: float,
    normal_y: float,
    uv: FloatArray,
    normal: FloatArray,
    order: IntArray,
    start: IntArray,
    size: tuple[int, int],
    reach_px: float,
) -> int:
    """The edge of a field that is nearest in position and direction; -1 if none is in reach."""
    columns, rows = int(size[0] / _CELL_PX) + 1, int(size[1] / _CELL_PX) + 1
    left = int(max(math.floor((x - reach_px) / _CELL_PX), 0.0))
    right = int(min(math.floor((x + reach_px) / _CELL_PX), columns - 1.0))
    top = int(max(math.floor((y - reach_px) / _CELL_PX), 0.0))
    bottom = int(min(math.floor((y + reach_px) / _CELL_PX), rows - 1.0))
    best, nearest = reach_px * reach_px, -1
    if left > right:
        return nearest
    for row in range(top, bottom + 1):
        # Cells beside each other are contiguous.
        for k in range(start[row * columns + left], start[row * columns + right + 1]):
            e = order[k]
            away = (uv[e, 0] - x) ** 2 + (uv[e, 1] - y) ** 2
            if away <= best:
                turned = (normal[e, 0] - normal_x) ** 2 + (normal[e, 1] - normal_y) ** 2
                away += PX_PER_TURN * PX_PER_TURN * turned
                if away <= best:
                    best, nearest = away, e
    return nearest


@compiled("f8[:,::1], f8[:,::1], f4[:,::1], f4[:,::1], i8[::1], i8[::1], UniTuple(i8, 2), f8")
def _nearest_edges(
    at: FloatArray,
    direction: FloatArray,
    uv: FloatArray,
    normal: FloatArray,
    order: IntArray,
    start: IntArray,
    size: tuple[int, int],
    reach_px: float,
) -> IntArray:
    found = np.empty(len(at), np.int64)
    for k in range(len(at)):
        found[k] = _nearest(
            at[k, 0], at[k, 1], direction[k, 0], direction[k, 1], uv, normal, order, start, size, reach_px
        )
    return found


@compiled(
    "f8[:,:,::1], i8[::1], i8[::1], f8[:,::1], f8[:,::1], f8[::1], f4[:,::1], f4[:,::1], f8[::1], i8[::1], i8[::1], "
    "UniTuple(i8, 2), UniTuple(f8, 4), f8"
)
def _partners(
    T_j_i: FloatArray,
    host: IntArray,
    edge: IntArray,
    uv: FloatArray,
    normal: FloatArray,
    inverse_depth: FloatArray,
    uv_j: FloatArray,
    normal_j: FloatArray,
    inverse_depth_j: FloatArray,
    order: IntArray,
    start: IntArray,
    size: tuple[int, int],
    K: tuple[float, float, float, float],
    max_px: float,
) -> IntArray:
    """Partner ``(P,)`` of edges in one target, -1 for none; ``T_j_i`` ``(W, 4, 4)`` takes each host to it."""
    fx, fy, cx, cy = K
    turn = 2.0 * PX_PER_TURN * math.sin(0.5 * MAX_TURN_RAD)
    reach_px = math.sqrt(max_px * max_px + turn * turn)
    partner = np.full(len(edge), -1)
    for k in range(len(edge)):
        e = edge[k]
        T, d = T_j_i[host[e]], inverse_depth[e]
        x, y = (uv[e, 0] - cx) / fx, (uv[e, 1] - cy) / fy
        X = T[0, 0] * x + T[0, 1] * y + T[0, 2] + T[0, 3] * d
        Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] + T[1, 3] * d
        Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] + T[2, 3] * d
        if not Z > 1e-6:
            continue
        u, v = X / Z * fx + cx, Y / Z * fy + cy
        if not (d > 0.0 and -0.5 <= u < size[0] - 0.5 and -0.5 <= v < size[1] - 0.5):
            continue
        # The normal rotates with the edge: move one pixel along the edge at the same depth.
        x_e, y_e = -normal[e, 1] / fx, normal[e, 0] / fy
        Z_e = T[2, 0] * x_e + T[2, 1] * y_e
        u_e = (T[0, 0] * x_e + T[0, 1] * y_e - X / Z * Z_e) * fx
        v_e = (T[1, 0] * x_e + T[1, 1] * y_e - Y / Z * Z_e) * fy
        length = math.copysign(max(math.sqrt(u_e * u_e + v_e * v_e), 1e-12), Z + Z_e)
        n_x, n_y = v_e / length, -u_e / length
        j = _nearest(u, v, n_x, n_y, uv_j, normal_j, order, start, size, reach_px)
        if j < 0 or (uv_j[j, 0] - u) ** 2 + (uv_j[j, 1] - v) ** 2 > max_px * max_px:
            continue
        if normal_j[j, 0] * n_x + normal_j[j, 1] * n_y < math.cos(MAX_TURN_RAD):
            continue
        known = inverse_depth_j[j]
        ratio = d / Z / known if known > 0.0 else 1.0
        if 1.0 / MAX_DEPTH_RATIO < ratio < MAX_DEPTH_RATIO:
            partner[k] = j
    return partner
