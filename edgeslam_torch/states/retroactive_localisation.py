"""Poses of lost frames, computed backwards in time once their place is mapped.

A kidnapped camera sees its new place at once, but that place is mapped or recognised later.
"""

from collections import deque

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.tracking.relocaliser import LIKELY_SHARE, place_of
from edgeslam_torch.tracking.tracker import Tracker, View
from edgeslam_torch.types import FloatArray, IntArray

MAX_FRAMES = 60
"""Maximum number of lost frames whose features are kept (3 MB): two seconds at 30 Hz."""
MISSES = 2
"""Consecutive failures after which the search through earlier frames stops."""

Frames = deque[tuple[int, View]]
"""Frames by their index."""


def place_lost_frames(
    lost: Frames, tracker: Tracker, log: TrajectoryLog, keyframe: Keyframe, T_c_w: FloatArray, anchors: IntArray
) -> int:
    """Track lost frames one by one, newest first, and remove them from ``lost``; returns the number of localised ones.

    Args:
        lost: Frames without a pose.
        tracker: With the map.
        log: Receives their poses.
        keyframe: Reference keyframe for these.
        T_c_w: ``(4, 4)`` pose of the frame that followed them.
        anchors: Anchors visible in that frame.
    """
    poses, missed = {}, 0
    while lost and missed < MISSES:
        index, view = lost.pop()
        track = tracker.track(view, T_c_w, anchors)
        if track is None or place_of(tracker, view, track).share < LIKELY_SHARE:
            missed += 1
            continue
        T_c_w, anchors, missed = track.T_c_w, track.anchor, 0
        poses[index] = T_c_w
    lost.clear()
    log.replace(poses, [keyframe])
    return len(poses)
