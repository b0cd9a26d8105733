"""Association of edge pixels with the nearest edge of another keyframe that has the same direction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import Edges, FloatArray, IntArray

MAX_TURN_RAD = 0.44
"""Maximum angle (25 degrees) between predicted and observed normal."""

PX_PER_TURN = 9.0
"""Weight of the angle between normals in the nearest-neighbour search [px/rad]: 25 degrees count as 4 px."""


@dataclass(frozen=True, slots=True)
class EdgeField:
    """Edge pixels of a keyframe, indexed by position and direction."""

    tree: cKDTree | None
    """Over ``(u, v, s nx, s ny)`` with ``s`` `PX_PER_TURN`, ``(E, 4)``; None to build one for each query, which is as
    fast for a field that is queried once, and saves its memory."""
    edges: Edges
    inverse_depth: FloatArray
    """``(E,)`` inverse depths of its edges [1/m]; zero where unknown."""
    size: tuple[int, int]
    """Width and height of the image [px]."""


def edge_field(edges: Edges, inverse_depth: FloatArray, size: tuple[int, int], indexed: bool = True) -> EdgeField:
    """Index a keyframe's edges.

    Args:
        edges: Edge pixels with their normals.
        inverse_depth: ``(E,)`` [1/m], zero where unknown.
        size: Width and height [px].
        indexed: Whether to keep a search tree.
    """
    return EdgeField(_tree(edges) if indexed else None, edges, np.asarray(inverse_depth), size)


def nearest_edges(field: EdgeField, uv: FloatArray, normal: FloatArray) -> IntArray:
    """Indices ``(N,)`` of the edge pixels nearest to pixels ``(N, 2)`` in position and direction."""
    tree = _tree(field.edges) if field.tree is None else field.tree
    found: IntArray = tree.query(_place(uv, normal))[1]
    return found


def _tree(edges: Edges) -> cKDTree:
    return cKDTree(_place(edges.uv, edges.normal))


def _place(uv: FloatArray, normal: FloatArray) -> FloatArray:
    return np.concatenate((np.asarray(uv, np.float64), PX_PER_TURN * np.asarray(normal, np.float64)), 1)


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
    max_turn_rad: float = MAX_TURN_RAD,
    max_depth_ratio: float = 1.35,
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
        max_turn_rad: Maximum angle between the predicted and the observed normal.
        max_depth_ratio: Maximum ratio between the predicted and the observed depth.
    """
    f, c = np.array(K[:2]), np.array(K[2:])
    parts = []
    order = np.argsort(pair_pose, kind="stable")
    poses, first = np.unique(np.asarray(pair_pose)[order], return_index=True)
    T_w_c = se3.inverse(T_c_w)
    for pose, mine in zip(poses, np.split(order, first[1:]), strict=False):  # without pairs there is one empty group
        field = fields[pose]
        if field is None or len(field.edges.uv) == 0:
            continue
        edge = np.asarray(pair_edge)[mine]
        T = (T_c_w[pose] @ T_w_c)[host[edge]]
        at, iz = _project(T, uv[edge], inverse_depth[edge], f, c)
        # The normal rotates with the edge: project a second point one pixel along the edge at the same depth.
        along = np.stack((-normal[edge, 1], normal[edge, 0]), 1)
        moved, _ = _project(T, uv[edge] + along, inverse_depth[edge], f, c)
        tangent = moved - at
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        predicted = np.stack((tangent[:, 1], -tangent[:, 0]), 1)
        ok = (iz > 0) & (at >= -0.5).all(1) & (at < np.array(field.size) - 0.5).all(1)
        edge, at, iz, predicted = edge[ok], at[ok], iz[ok], predicted[ok]
        partner = nearest_edges(field, at, predicted)
        step = at - field.edges.uv[partner]
        seen = field.edges.normal[partner].astype(np.float64)
        partner_iz = field.inverse_depth[partner].astype(np.float64)
        ok = (step * step).sum(1) <= max_px**2
        ok &= (seen * predicted).sum(1) >= np.cos(max_turn_rad)
        ratio = np.where(partner_iz > 0, iz / np.where(partner_iz > 0, partner_iz, 1.0), 1.0)
        ok &= (ratio < max_depth_ratio) & (ratio > 1.0 / max_depth_ratio)
        k = np.flatnonzero(ok)
        target = np.full(len(k), pose, dtype=np.int64)
        parts.append((edge[k], target, field.edges.uv[partner[k]].astype(np.float64), seen[k], partner_iz[k]))
    if not parts:
        none, two = np.zeros(0), np.zeros((0, 2))
        return EdgePairs(np.zeros(0, np.int64), np.zeros(0, np.int64), two, two, none)
    return EdgePairs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _project(
    T: FloatArray, uv: FloatArray, inverse_depth: FloatArray, f: FloatArray, c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(P, 2)`` and inverse depths ``(P,)`` in the target; not positive behind it."""
    ray = (uv - c) / f
    q = T[:, :3, 0] * ray[:, :1] + T[:, :3, 1] * ray[:, 1:] + T[:, :3, 2] + T[:, :3, 3] * inverse_depth[:, None]
    front = q[:, 2] > 1e-6
    z = np.where(front, q[:, 2], 1.0)
    return np.where(front[:, None], q[:, :2] / z[:, None] * f + c, -1e6), np.where(front, inverse_depth / z, -1.0)
