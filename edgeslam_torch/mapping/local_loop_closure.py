"""Local loop closure: two keyframes observe the same place but share no anchors because of drift.

A search of a few pixels (`mapping/fuse.py`) misses anchors that drift has moved farther. Here an old keyframe's
anchors are searched in a larger radius and accepted if one camera pose explains them. The poses must already be near
each other; `atlas/atlas.py` recognises places that drift has put elsewhere.
"""

import logging

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.fuse import look_for, merge, observe_or_pair
from edgeslam_torch.noise import VISUAL_DRIFT, VISUAL_DRIFT_TURN
from edgeslam_torch.optim.pose_only import refine_pose
from edgeslam_torch.types import FloatArray, IntArray

logger = logging.getLogger(__name__)

NEAR_PX, FAR_PX = 10.0, 30.0
"""Search radius at pyramid level 0 for a camera that has hardly moved in between, and the largest: 3 degrees at 525 px,
drift of 6 % of the depth. In between, what the way allows: on wallpaper, the next repetition fits as well."""
SURE = 3.0
"""Standard deviations of the drift that are searched."""
RATIO = 0.85
"""Maximum ratio of nearest to second nearest descriptor distance."""
MIN_INLIERS = 15
"""Minimum number of matches explained by one pose: as many as make two keyframes covisible."""
MIN_SHARE = 0.5
"""Minimum share of inliers: the majority of the matches."""
MAX_TURN_RAD = np.deg2rad(30.0)
"""Maximum angle between the two views: beyond it, views of 60 degrees share less than half."""
MAX_SHIFT = 0.35
"""Maximum distance of the two cameras relative to the newer one's median depth: 20 degrees of parallax."""
MAX_DRIFT_PX = 5.0
"""Drift above which the whole map is refined; below, tracking finds the anchors within its ``map_radius_px``."""
MIN_SHARED = 15
"""Minimum number of shared anchors of covisible keyframes, as in `SlamMap.covisible`."""


def revisit_candidate(slam_map: SlamMap, keyframe: Keyframe) -> Keyframe | None:
    """Revisit candidate: the older keyframe nearest in position and direction that shares few anchors with this one,
    or None."""
    piece = slam_map.piece_of(keyframe.id)  # poses of another one do not relate
    older = [k for k in slam_map.keyframes.values() if k.id < keyframe.id and slam_map.piece_of(k.id) == piece]
    depth = slam_map.median_depth(keyframe)
    if not older or depth is None:
        return None
    cosine = np.stack([k.T_c_w[2, :3] for k in older]) @ keyframe.T_c_w[2, :3]
    turn = np.arccos(np.clip(cosine, -1.0, 1.0)) / MAX_TURN_RAD
    shift = np.linalg.norm(np.stack([k.centre_w for k in older]) - keyframe.centre_w, axis=1) / (MAX_SHIFT * depth)
    counts = slam_map.shared_counts(keyframe.anchor[keyframe.anchor >= 0])
    shared = np.array([counts.get(k.id, 0) for k in older])
    distance = np.where((turn < 1.0) & (shift < 1.0) & (shared < MIN_SHARED), turn + shift, np.inf)
    nearest = int(distance.argmin())
    return older[nearest] if np.isfinite(distance[nearest]) else None


def reobserve(slam_map: SlamMap, camera: Camera, keyframe: Keyframe) -> float | None:
    """Match a keyframe with an old one of the same place, if one is found and verified.

    The map is not refined here; until then, merged observations differ by the drift.

    Returns:
        The drift: median distance [px] of the old anchors from their projections; None without a match.
    """
    old = revisit_candidate(slam_map, keyframe)
    if old is None:
        return None
    anchors, growth = slam_map.anchors, slam_map.scale_factor
    ids = slam_map.anchors_seen_by([old, *slam_map.covisible(old, 5)])
    ids = ids[anchors.alive[ids] & ~anchors.from_depth[ids]]
    radius_px = min(NEAR_PX + SURE * _drift_px(slam_map, camera, old, keyframe), FAR_PX)
    found, keypoint, error = look_for(slam_map, camera, keyframe, ids, radius_px, 1.0, RATIO)
    if len(found) < MIN_INLIERS:
        return None
    inliers = _agreeing(keyframe, anchors.p_w[found], keypoint, camera, growth)
    if inliers.sum() < MIN_INLIERS or inliers.mean() < MIN_SHARE:
        return None
    merge(slam_map, [observe_or_pair(slam_map, keyframe, found[inliers], keypoint[inliers])])
    logger.info("keyframe of frame %d joined with that of frame %d", keyframe.frame_index, old.frame_index)
    return float(np.median(np.linalg.norm(error[inliers], axis=1)))


def _drift_px(slam_map: SlamMap, camera: Camera, old: Keyframe, new: Keyframe) -> float:
    """Standard deviation [px] of the map's drift along the keyframes between two, at the newer one's depth."""
    between = [slam_map.keyframes[id] for id in sorted(slam_map.keyframes) if old.id <= id <= new.id]
    path = np.linalg.norm(np.diff([k.centre_w for k in between], axis=0), axis=1).sum()
    axis = np.stack([k.T_c_w[2, :3] for k in between])
    turn_rad = np.arccos(np.clip((axis[1:] * axis[:-1]).sum(axis=1), -1.0, 1.0)).sum()
    depth = slam_map.median_depth(new) or np.inf
    return float(camera.fx * np.hypot(VISUAL_DRIFT * path / depth, VISUAL_DRIFT_TURN * turn_rad))


def _agreeing(
    keyframe: Keyframe, p_w: FloatArray, keypoint: IntArray, camera: Camera, growth: float
) -> NDArray[np.bool_]:
    """Inliers of one camera pose, ``(M,)``."""
    uv = keyframe.features.uv[keypoint].astype(np.float64)
    inv_sigma = growth ** -keyframe.features.octave[keypoint].astype(np.float64)
    return refine_pose(keyframe.T_c_w, p_w, uv, inv_sigma, (camera.fx, camera.fy, camera.cx, camera.cy)).inliers
