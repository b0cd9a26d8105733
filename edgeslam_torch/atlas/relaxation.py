"""Relaxation of the map on links: keyframes, anchors, edges and frames move so that both ends of the links agree.

A pose graph of similarities (`optim/pose_graph.py`) distributes the correction over the keyframes. Anchors, edges and
frames move with their keyframes; then both ends share anchors. Refinement follows.
"""

from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.links import Link
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.atlas.submap_graph import shared_anchors
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.fuse import look_for, merge, observe_or_pair
from edgeslam_torch.mapping.refinement import refine_all
from edgeslam_torch.optim.pose_graph import PoseGraph, solve
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.types import FloatArray, IntArray

MIN_BASELINE = 0.02
"""Minimum distance of two keyframes relative to the depth: bounds the weight of their relative scale from below."""
RADIUS_PX = 12.0
"""Search radius at pyramid level 0 for anchors of the other side near a link: the submaps agree to a few per cent of
the depth there."""
RATIO = 0.85
AROUND = 10
"""Covisible keyframes of a link, on either side, whose anchors are searched in the other side."""
ITERATIONS = 20


def relaxed(slam_map: SlamMap, links: list[Link]) -> dict[int, FloatArray]:
    """Similarity ``(4, 4)`` of every keyframe of a submap that makes both ends of links in it agree."""
    piece = slam_map.piece_of(links[0].keyframe.id)
    members = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    row_of = {k.id: row for row, k in enumerate(members)}
    depth = [slam_map.median_depth(k) or 1.0 for k in members]
    T = np.stack([k.T_c_w for k in members])
    i, j, S_ij, inv_sigma = [], [], [], []

    def add(a: int, b: int, S: FloatArray, shared: int, distance: float) -> None:
        i.append(a)
        j.append(b)
        S_ij.append(S)
        inv_sigma.append(_inv_sigma(shared, depth[a], distance))

    for (a, b), count in shared_anchors(slam_map, members).items():
        relative = T[a] @ se3.inverse(T[b])
        add(a, b, relative, count, max(float(np.linalg.norm(relative[:3, 3])) / depth[a], MIN_BASELINE))
    for one in links:
        a, b = row_of[one.keyframe.id], row_of[one.other.id]
        S = T[a] @ sim3.inverse(one.S) @ se3.inverse(T[b])
        add(a, b, S, len(one.keypoint), 1.0 if one.by_images else MIN_BASELINE)
    old = np.flatnonzero([k.stamp_s == BEFORE_S for k in members])
    fixed = old if len(old) else np.zeros(1, dtype=np.int64)  # keyframes of an earlier flight define axes and scale
    nodes = solve(PoseGraph(T, fixed, np.array(i), np.array(j), np.stack(S_ij), np.stack(inv_sigma)))
    return {k.id: np.linalg.inv(node) @ k.T_c_w for k, node in zip(members, nodes, strict=True)}


def _inv_sigma(shared: int, depth: float, distance: float) -> FloatArray:
    """Weights ``(7,)`` of an edge, up to a common factor.

    Every common keypoint gives a direction. That constrains the rotation, the translation relative to the depth, and
    the scale by parallax: less the shorter the baseline.

    Args:
        shared: Number of keypoints.
        depth: Median depth in the keyframe [map units].
        distance: Distance of the keyframes, relative to the depth.
    """
    return np.sqrt(max(shared, 1)) * np.array([1.0 / depth] * 3 + [1.0] * 3 + [min(distance, 1.0)])


def move(slam_map: SlamMap, edges: EdgeMap, log: TrajectoryLog, S: dict[int, FloatArray]) -> dict[int, float]:
    """Move keyframes by a similarity ``(4, 4)`` each, with their anchors, edges, frames, and removed keyframes.

    No anchor may be observed by other keyframes as well.

    Returns:
        Change of scale at each keyframe, including removed ones.
    """
    scale = {id: sim3.scale_of(moved) for id, moved in S.items()}
    with slam_map.lock:
        for id, ids in _hosted(slam_map, [slam_map.keyframes[id] for id in S]).items():
            _move_anchors(slam_map, ids, S[id])
        for id, moved in S.items():
            keyframe = slam_map.keyframes[id]
            keyframe.T_c_w = sim3.moved_camera(moved, keyframe.T_c_w)
            keyframe.scale(scale[id])
        slam_map.scale_links(scale)
        for host in edges.hosts:
            host.grow(scale.get(slam_map.resolve(host.keyframe_id)[0], 1.0))
        log.scale(scale)
    return scale | {id: scale[heir] for id in slam_map.links if (heir := slam_map.resolve(id)[0]) in scale}


def _hosted(slam_map: SlamMap, members: list[Keyframe]) -> dict[int, IntArray]:
    """Ids of the anchors that move with each keyframe: the host of their depth prior, or the newest observer."""
    anchors = slam_map.anchors
    owner = np.full(len(anchors.alive) + 1, -1, dtype=np.int64)  # the last row is for NO_ANCHOR
    for keyframe in members:
        owner[keyframe.anchor] = keyframe.id
    owner = owner[:-1]
    alive = {k.id for k in members}
    for id in np.flatnonzero((owner >= 0) & anchors.from_depth):
        successor = slam_map.resolve(int(anchors.host[id]))[0] if anchors.host[id] >= 0 else -1
        owner[id] = successor if successor in alive else owner[id]
    return {k.id: np.flatnonzero(owner == k.id) for k in members}


def _move_anchors(slam_map: SlamMap, ids: IntArray, S: FloatArray) -> None:
    """Move anchors ``(M,)`` and their depth priors by a similarity ``(4, 4)``."""
    anchors, (scale, R, _) = slam_map.anchors, sim3.parts(S)
    anchors.p_w[ids] = sim3.transform(S, anchors.p_w[ids])
    anchors.origin[ids] = sim3.transform(S, anchors.origin[ids])
    anchors.normal[ids] = anchors.normal[ids] @ R.T
    anchors.max_distance[ids] *= scale
    anchors.sigma[ids] *= scale
    anchors.prior[ids] /= scale


# -- common anchors ----------------------------------------------------------------------------------------------


def merge_submaps(slam_map: SlamMap, camera: Camera, links: list[Link], lm: LmConfig) -> None:
    """Merge the anchors of two aligned submaps and refine the result."""
    share_anchors(slam_map, links)
    thorough = replace(lm, max_iterations=ITERATIONS if lm.max_iterations else 0)  # none without reprojection terms
    refine_all(slam_map, camera, thorough)
    look_around(slam_map, camera, links)
    refine_all(slam_map, camera, thorough)


def share_anchors(slam_map: SlamMap, links: list[Link]) -> None:
    """Let both ends of links observe the same anchors and belong to one submap."""
    with slam_map.lock:
        for link in links:
            alive = slam_map.anchors.alive[link.anchor] & ~np.isin(link.anchor, link.keyframe.anchor)
            merge(slam_map, [observe_or_pair(slam_map, link.keyframe, link.anchor[alive], link.keypoint[alive])])
            slam_map.join_pieces(link.keyframe, [link.other])


def look_around(slam_map: SlamMap, camera: Camera, links: list[Link]) -> None:
    """Search each side's anchors in the other side's keyframes near links."""
    with slam_map.lock:
        for link in links:
            sides = [_around(slam_map, link.keyframe.id), _around(slam_map, link.other.id)]
            for keyframes, others in (sides, sides[::-1]):
                for keyframe in keyframes:
                    ids = slam_map.anchors_seen_by(others)
                    ids = ids[slam_map.anchors.alive[ids] & ~slam_map.anchors.from_depth[ids]]
                    growth = slam_map.scale_factor
                    found, keypoint, _ = look_for(slam_map, camera, keyframe, ids, RADIUS_PX, growth, RATIO)
                    merge(slam_map, [observe_or_pair(slam_map, keyframe, found, keypoint)])
        slam_map.refresh_anchors(np.flatnonzero(slam_map.anchors.alive))


def _around(slam_map: SlamMap, keyframe_id: int) -> list[Keyframe]:
    keyframe = slam_map.keyframes.get(keyframe_id)
    return [] if keyframe is None else [keyframe, *slam_map.covisible(keyframe, AROUND)]
