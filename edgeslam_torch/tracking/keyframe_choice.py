"""When a tracked frame should become a keyframe: by view change and parallax, not by time."""

import numpy as np

from edgeslam_torch.config import MappingConfig
from edgeslam_torch.mapping.keyframe import Keyframe
from edgeslam_torch.mapping.slam_map import SlamMap
from edgeslam_torch.tracking.flow import Followed
from edgeslam_torch.tracking.tracker import Track

SHORTEST_GAP = 2
"""Frames between keyframes however much the view changes."""


def lost_sight(followed: Followed, config: MappingConfig) -> bool:
    """Whether flow finds too little of the last keyframe."""
    return followed.share < config.keyframe_followed


def lost_most(followed: Followed, config: MappingConfig) -> bool:
    """Whether so much of the last keyframe is out of sight that the next one cannot wait: a fast turn."""
    return followed.share < config.keyframe_at_once


def few_matches(track: Track, reference: Keyframe, slam_map: SlamMap, config: MappingConfig) -> bool:
    """Whether matching finds too few of the reference keyframe's anchors."""
    # Anchors that two keyframes alone have seen come and go; overlap is judged by the others.
    held = reference.anchor[reference.anchor >= 0]
    established = int((slam_map.anchors.observations[held] >= min(3, len(slam_map.keyframes))).sum())
    return track.inliers < config.keyframe_overlap * established


def is_due(
    changed: bool, parallax_rad: float, frames_since_keyframe: int, config: MappingConfig, at_once: bool = False
) -> bool:
    """Whether a frame should become a keyframe.

    Args:
        changed: What it sees differs from the reference keyframe: `lost_sight` or `few_matches`.
        parallax_rad: Median ray angle to the reference keyframe.
        frames_since_keyframe: Frames since the last one.
        config: Thresholds.
        at_once: No time to wait for ``keyframe_min_gap``: `lost_most`.
    """
    if frames_since_keyframe < (SHORTEST_GAP if at_once else config.keyframe_min_gap):
        return False
    moved = parallax_rad > np.deg2rad(config.keyframe_parallax_deg)
    overdue = frames_since_keyframe >= config.keyframe_max_gap and parallax_rad > np.deg2rad(
        0.25 * config.keyframe_parallax_deg
    )
    return changed or moved or overdue
