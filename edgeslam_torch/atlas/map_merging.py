"""Merging of two submaps with known similarity: move one, share anchors, refine."""

import logging
from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.links import Link
from edgeslam_torch.geometry import sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.fuse import look_for, merge, observe_or_pair
from edgeslam_torch.mapping.refinement import refine_all
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.types import FloatArray, IntArray

logger = logging.getLogger(__name__)

RADIUS_PX = 12.0
"""Search radius at pyramid level 0 for anchors of the other side near a link: the submaps agree to a few per cent of
the depth there."""
RATIO = 0.85
NEIGHBOURS = 10
"""Covisible keyframes of a link, on either side, whose anchors are searched in the other side."""
ITERATIONS = 20


def move_piece(slam_map: SlamMap, edges: EdgeMap, log: TrajectoryLog, piece: int, S: FloatArray) -> None:
    """Move a submap by a similarity ``(4, 4)``; its images stay the same.

    No anchor may be observed from two submaps.
    """
    mine = [k for k in slam_map.keyframes.values() if slam_map.piece_of(k.id) == piece]
    with slam_map.lock:
        move_anchors(slam_map.anchors, slam_map.anchors_seen_by(mine), S)
        move_keyframes(slam_map, edges, log, {k.id: S for k in mine})


def move_keyframes(slam_map: SlamMap, edges: EdgeMap, log: TrajectoryLog, S: dict[int, FloatArray]) -> None:
    """Move keyframes by a similarity ``(4, 4)`` each.

    Links to removed keyframes, measured edges, and frames move with them; anchors by `move_anchors`.
    """
    scale = {id: sim3.scale_of(moved) for id, moved in S.items()}
    with slam_map.lock:
        for id, moved in S.items():
            keyframe = slam_map.keyframes[id]
            keyframe.T_c_w = sim3.moved_camera(moved, keyframe.T_c_w)
            keyframe.scale(scale[id])
        slam_map.scale_links(scale)
        for host in edges.hosts:
            host.grow(scale.get(slam_map.resolve(host.keyframe_id)[0], 1.0))
        log.scale(scale)


def move_anchors(anchors: Anchors, ids: IntArray, S: FloatArray) -> None:
    """Move anchors ``(M,)`` and their depth priors by a similarity ``(4, 4)``."""
    scale, R, _ = sim3.parts(S)
    anchors.p_w[ids] = sim3.transform(S, anchors.p_w[ids])
    anchors.origin[ids] = sim3.transform(S, anchors.origin[ids])
    anchors.normal[ids] = anchors.normal[ids] @ R.T
    anchors.max_distance[ids] *= scale
    anchors.sigma[ids] *= scale
    anchors.prior[ids] /= scale


def merge_submaps(slam_map: SlamMap, camera: Camera, links: list[Link], lm: LmConfig) -> int:
    """Merge the anchors of two aligned submaps and refine the result.

    Returns:
        Number of anchors found to be common.
    """
    with slam_map.lock:
        fused = share_anchors(slam_map, links)
    thorough = replace(lm, max_iterations=ITERATIONS if lm.max_iterations else 0)  # none without reprojection terms
    refine_all(slam_map, camera, thorough)
    fused += look_around(slam_map, camera, links)
    refine_all(slam_map, camera, thorough)
    logger.info("merged at %d keyframes, %d anchors in common", len(links), fused)
    return fused


def share_anchors(slam_map: SlamMap, links: list[Link]) -> int:
    """Let both ends of links observe the same anchors and belong to one submap; returns the number merged."""
    before = len(slam_map.anchors)
    for link in links:
        alive = slam_map.anchors.alive[link.anchor] & ~np.isin(link.anchor, link.keyframe.anchor)
        merge(
            slam_map,
            [observe_or_pair(slam_map, link.keyframe, link.anchor[alive], link.keypoint[alive])],
        )
        slam_map.join_pieces(link.keyframe, [link.other])
    return before - len(slam_map.anchors)


def look_around(slam_map: SlamMap, camera: Camera, links: list[Link]) -> int:
    """Search each side's anchors in the other side's keyframes near links; returns the number of anchors merged."""
    with slam_map.lock:
        fused = sum(_look_around(slam_map, camera, link) for link in links)
        slam_map.refresh_anchors(np.flatnonzero(slam_map.anchors.alive))
    return fused


def _look_around(slam_map: SlamMap, camera: Camera, link: Link) -> int:
    sides = [_around(slam_map, link.keyframe.id), _around(slam_map, link.other.id)]
    before = len(slam_map.anchors)
    for keyframes, others in (sides, sides[::-1]):
        for keyframe in keyframes:
            ids = _triangulated(slam_map, slam_map.anchors_seen_by(others))
            growth = slam_map.scale_factor
            found, keypoint, _ = look_for(slam_map, camera, keyframe, ids, RADIUS_PX, growth, RATIO)
            merge(slam_map, [observe_or_pair(slam_map, keyframe, found, keypoint)])
    return before - len(slam_map.anchors)


def _around(slam_map: SlamMap, keyframe_id: int) -> list:
    keyframe = slam_map.keyframes.get(keyframe_id)
    return [] if keyframe is None else [keyframe, *slam_map.covisible(keyframe, NEIGHBOURS)]


def _triangulated(slam_map: SlamMap, ids: IntArray) -> IntArray:
    return ids[slam_map.anchors.alive[ids] & ~slam_map.anchors.from_depth[ids]]
