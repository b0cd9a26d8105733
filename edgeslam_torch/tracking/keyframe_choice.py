"""Keyframe selection by change of view and parallax."""

import numpy as np

from edgeslam_torch.config import MappingConfig
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.tracking.flow import Followed
from edgeslam_torch.tracking.tracker import Track

SHORTEST_GAP_S = 0.04
"""Minimum time between keyframes whatever the change of view: every second frame at 30 Hz, every frame at 20."""


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
