"""Search known anchors in keyframes that do not observe them yet: more observations, fewer duplicates."""

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.projection import match_projection, project_anchors
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, IntArray

RADIUS_PX = 3.0
"""Search radius at pyramid level 0; poses and points are refined already."""
MAX_HAMMING = 50
"""Maximum Hamming distance [bits of 256]; the strict threshold of ORB-SLAM2, as there is no ratio test."""
NEW_KEYFRAMES = 3
"""Number of keyframes during which a new anchor is searched in its neighbours."""

Pairs = tuple[IntArray, IntArray]
"""Ids ``(M,)`` of pairs of anchors that may be duplicates."""


def fuse_new(slam_map: SlamMap, camera: Camera, keyframe: Keyframe, neighbours: list[Keyframe]) -> None:
    """Search a keyframe's new anchors in its neighbours; `fuse_all` searches all."""
    ids = slam_map.anchors_seen_by([keyframe])
    new = ids[slam_map.anchors.born[ids] > keyframe.id - NEW_KEYFRAMES]
    merge(slam_map, [_look_in(slam_map, camera, k, new) for k in neighbours])


def fuse_all(slam_map: SlamMap, camera: Camera) -> None:
    """Search every anchor in every keyframe of its submap, after all poses are refined."""
    anchors = slam_map.anchors
    pieces: dict[int, list[Keyframe]] = {}
    for keyframe in slam_map.keyframes.values():
        pieces.setdefault(slam_map.piece_of(keyframe.id), []).append(keyframe)
    for keyframes in pieces.values():
        ids = slam_map.anchors_seen_by(keyframes)
        for keyframe in keyframes:
            known = ids[anchors.alive[ids] & ~anchors.from_depth[ids]]
            merge(slam_map, [_look_in(slam_map, camera, keyframe, known)])
    slam_map.refresh_anchors(np.flatnonzero(anchors.alive))


def look_for(
    slam_map: SlamMap,
    camera: Camera,
    keyframe: Keyframe,
    ids: IntArray,
    radius_px: float,
    per_level: float,
    ratio: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Search anchors that a keyframe does not observe around their projections.

    Args:
        slam_map: Holds keyframe and anchors.
        camera: Intrinsics.
        keyframe: Where to look.
        ids: Anchors to look for.
        radius_px: Search radius at pyramid level 0.
        per_level: Factor by which the radius grows with every level.
        ratio: Maximum ratio of nearest to second nearest descriptor distance.

    Returns:
        Found anchors ``(M,)``, their keypoints ``(M,)``, and predicted minus observed pixels ``(M, 2)``.
    """
    anchors = slam_map.anchors
    observed = np.zeros(len(anchors.alive) + 1, dtype=bool)  # the last row is for NO_ANCHOR
    observed[keyframe.anchor] = True
    ids = ids[~observed[ids]]
    seen = project_anchors(anchors, ids, keyframe.T_c_w, camera, slam_map.scale_factor, slam_map.levels)
    matches = match_projection(
        seen,
        anchors.words[seen.anchor],
        keyframe.words,
        keyframe.features.octave,
        keyframe.grid,
        radius_px * per_level ** seen.octave.astype(np.float64),
        MAX_HAMMING,
        ratio,
    )
    error = seen.uv[matches.query] - keyframe.features.uv[matches.train]
    return seen.anchor[matches.query], matches.train, error


def observe_or_pair(slam_map: SlamMap, keyframe: Keyframe, found: IntArray, keypoint: IntArray) -> Pairs:
    """Observe anchors ``(M,)`` on a keyframe's free keypoints; returns the others paired with the anchors that occupy
    their keypoints."""
    observed = keyframe.anchor[keypoint]
    free = observed < 0
    slam_map.observe(keyframe, keypoint[free], found[free])
    return found[~free], observed[~free]


def _look_in(slam_map: SlamMap, camera: Camera, keyframe: Keyframe, ids: IntArray) -> Pairs:
    """Search and observe anchors in a keyframe; returns duplicates as pairs."""
    growth = slam_map.scale_factor
    found, keypoint, error = look_for(slam_map, camera, keyframe, ids, RADIUS_PX, growth, 1.0)
    sigma = growth ** keyframe.features.octave[keypoint].astype(np.float64)
    good = (error**2).sum(1) <= CHI2_2DOF_95 * sigma**2
    return observe_or_pair(slam_map, keyframe, found[good], keypoint[good])


def merge(slam_map: SlamMap, doubles: list[Pairs]) -> None:
    """Merge duplicate anchors; the one with more observations is kept."""
    if not doubles:
        return
    a, b = (np.concatenate(side) for side in zip(*doubles, strict=True))
    keep_a = slam_map.anchors.observations[a] >= slam_map.anchors.observations[b]
    winners, losers = np.where(keep_a, a, b), np.where(keep_a, b, a)
    # An id may occur in several pairs; only disjoint pairs are merged now, the rest at a later keyframe.
    _, first = np.unique(np.concatenate([winners, losers]), return_index=True)
    once = np.zeros(2 * len(a), dtype=bool)
    once[first] = True
    disjoint = once[: len(a)] & once[len(a) :]
    slam_map.merge_anchors(losers[disjoint], winners[disjoint])
