"""Poses of lost frames, computed backwards in time once their place is mapped.

A kidnapped camera sees its new place at once, but that place is mapped or recognised later.
"""

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.states.system import System
from edgeslam_torch.tracking.relocaliser import LIKELY_SHARE, place_of
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import FloatArray, IntArray

MAX_FRAMES = 60
"""Maximum number of lost frames whose features are kept (3 MB): two seconds at 30 Hz."""
MISSES = 2
"""Consecutive failures after which the search through earlier frames stops."""


class RetroactiveLocalisation:
    """Stores the frames of the current loss."""

    def __init__(self, system: System) -> None:
        self.system = system
        self._lost: list[tuple[int, View]] = []

    def keep(self, index: int, view: View) -> None:
        """Store a frame without a pose by its index; beyond the limit the oldest is dropped."""
        self._lost = [*self._lost[1 - MAX_FRAMES :], (index, view)]

    def place(self, keyframe: Keyframe, T_c_w: FloatArray, anchors: IntArray) -> int:
        """Track the lost frames one by one, newest first.

        Args:
            keyframe: Reference keyframe for their poses.
            T_c_w: ``(4, 4)`` pose of the frame that followed them.
            anchors: Anchors visible in that frame.

        Returns:
            Number of frames localised.
        """
        tracker, poses, missed = self.system.tracker, {}, 0
        for index, view in reversed(self._lost):
            track = tracker.track(view, T_c_w, anchors)
            if track is None or place_of(tracker, view, track).share < LIKELY_SHARE:
                missed += 1
                if missed >= MISSES:
                    break
                continue
            T_c_w, anchors, missed = track.T_c_w, track.anchor, 0
            poses[index] = T_c_w
        self._lost = []
        self.system.log.replace(poses, [keyframe])
        return len(poses)
