"""Keyframe selection by change of view and parallax."""

import numpy as np

from edgeslam_torch.config import MappingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.tracking.flow import Followed
from edgeslam_torch.tracking.relocaliser import cells_of
from edgeslam_torch.tracking.tracker import Track
from edgeslam_torch.types import FloatArray

SHORTEST_GAP_S = 0.04
"""Minimum time between keyframes whatever the change of view: every second frame at 30 Hz, every frame at 20."""

OLD_S = 10.0
"""Age from which on a keyframe counts as one of an earlier visit: a hand that waves, or a turn on the spot, brings
another view of what it is looking at, which the map profits from (docs/decisions/0079)."""
KNOWN_SHARE = 0.8
"""Share of a view that earlier visits must have seen for it to add nothing: 0.81 and more from the third pass over a
place on, below 0.05 on new ground."""
VISITS = 10
"""Keyframes of earlier visits that are asked: those that see most of the same."""


def lost_sight(followed: Followed, config: MappingConfig) -> bool:
    """Whether flow tracks too few keypoints of the last keyframe."""
    return followed.share < config.keyframe_followed


def lost_most(followed: Followed, config: MappingConfig) -> bool:
    """Whether so few keypoints of the last keyframe are tracked that the next one cannot wait: a fast rotation."""
    return followed.share < config.keyframe_at_once


def due_by_flow(followed: Followed, parallax_rad: float, since_keyframe_s: float, config: MappingConfig) -> bool:
    """Whether a frame that was followed should become a keyframe; arguments as in `is_due`."""
    changed, at_once = lost_sight(followed, config), lost_most(followed, config)
    return is_due(changed, parallax_rad, since_keyframe_s, config, at_once)


def few_matches(track: Track, reference: Keyframe, slam_map: SlamMap, config: MappingConfig) -> bool:
    """Whether too few of the reference keyframe's anchors are matched."""
    # Anchors of only two keyframes are unstable; overlap is measured on the others.
    held = reference.anchor[reference.anchor >= 0]
    established = int((slam_map.anchors.observations[held] >= min(3, len(slam_map.keyframes))).sum())
    return track.inliers < config.keyframe_overlap * established


def is_due(
    changed: bool, parallax_rad: float, since_keyframe_s: float, config: MappingConfig, at_once: bool = False
) -> bool:
    """Whether a frame should become a keyframe.

    Args:
        changed: The view differs from the reference keyframe: `lost_sight` or `few_matches`.
        parallax_rad: Median ray angle to the reference keyframe.
        since_keyframe_s: Time since the last one.
        config: Thresholds.
        at_once: Do not wait for ``keyframe_min_gap_s``: `lost_most`.
    """
    if since_keyframe_s < (SHORTEST_GAP_S if at_once else config.keyframe_min_gap_s):
        return False
    moved = parallax_rad > np.deg2rad(config.keyframe_parallax_deg)
    overdue = since_keyframe_s >= config.keyframe_max_gap_s and parallax_rad > np.deg2rad(
        0.25 * config.keyframe_parallax_deg
    )
    return changed or moved or overdue


def known_share(
    track: Track, uv: FloatArray, stamp_s: float, slam_map: SlamMap, camera: Camera, config: MappingConfig
) -> float:
    """Share of a view, in cells that hold keypoints, that keyframes of earlier visits have seen from the same side.

    A cell is known when a triangulated anchor found in it was seen by such a keyframe at less parallax than makes a
    keyframe, and less than a pyramid level nearer or farther: a keyframe here would see nothing new of it.

    Args:
        track: Anchors found in the frame.
        uv: All keypoints of the frame ``(N, 2)``.
        stamp_s: Of the frame.
        slam_map: With the keyframes.
        camera: Of the frame.
        config: Whose parallax makes a keyframe.
    """
    anchor = track.anchor
    keypoint = track.keypoint[~slam_map.anchors.from_depth[anchor]]
    anchor = anchor[~slam_map.anchors.from_depth[anchor]]
    counts = slam_map.shared_counts(anchor)
    old = [id for id in counts if stamp_s - slam_map.keyframes[id].stamp_s >= OLD_S]
    row_of = np.full(len(slam_map.anchors.alive) + 1, -1, dtype=np.int64)
    row_of[anchor] = np.arange(len(anchor))
    ray = slam_map.anchors.p_w[anchor] - se3.inverse(track.T_c_w)[:3, 3]
    distance = np.linalg.norm(ray, axis=1)
    known = np.zeros(len(anchor), dtype=bool)
    for id in sorted(old, key=lambda id: (-counts[id], -id))[:VISITS]:
        keyframe = slam_map.keyframes[id]
        mine = row_of[keyframe.anchor[keyframe.anchor >= 0]]
        mine = mine[mine >= 0]
        other = slam_map.anchors.p_w[anchor[mine]] - keyframe.centre_w
        far = np.linalg.norm(other, axis=1)
        cosine = np.einsum("ij,ij->i", ray[mine], other) / np.maximum(distance[mine] * far, 1e-12)
        alike = np.abs(np.log(distance[mine] / np.maximum(far, 1e-12))) <= np.log(slam_map.scale_factor)
        known[mine] |= alike & (cosine >= np.cos(np.deg2rad(config.keyframe_parallax_deg)))
    return len(cells_of(camera, uv[keypoint[known]])) / max(1, len(cells_of(camera, uv)))
