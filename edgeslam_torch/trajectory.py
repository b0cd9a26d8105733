"""Poses of all frames, each tied to a keyframe so that it moves when the map is refined."""

import bisect
import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.keyframe import Keyframe
from edgeslam_torch.mapping.slam_map import SlamMap
from edgeslam_torch.types import FloatArray


@dataclass(slots=True)
class FrameRecord:
    """One frame's pose relative to a keyframe."""

    index: int
    stamp_s: float
    keyframe_id: int
    T_c_k: FloatArray
    """``(4, 4)``"""


class TrajectoryLog:
    """Every frame stepped so far."""

    def __init__(self, slam_map: SlamMap) -> None:
        self.map = slam_map
        self.records: list[FrameRecord] = []

    def append(self, index: int, stamp_s: float, keyframe_id: int, T_c_w: FloatArray) -> None:
        """Record a frame's pose in the map as it is now."""
        with self.map.lock:
            T_c_k = T_c_w @ se3.inverse(self.map.pose_of(keyframe_id))
        self.records.append(FrameRecord(index, stamp_s, keyframe_id, T_c_k))

    def replace(self, T_c_w_of_frame: dict[int, FloatArray], keyframes: list[Keyframe]) -> None:
        """Give recent frames, by index, new poses, each tied to the last of the keyframes (in order) before it."""
        indices = [k.frame_index for k in keyframes]
        for record in reversed(self.records):
            if record.index not in T_c_w_of_frame:
                break
            keyframe = keyframes[max(bisect.bisect_right(indices, record.index) - 1, 0)]
            record.keyframe_id = keyframe.id
            record.T_c_k = T_c_w_of_frame[record.index] @ keyframe.T_w_c

    def poses(self, since_s: float = -math.inf) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and ``T_w_c`` ``(F, 4, 4)`` in the map as it is now, of frames not older than ``since_s``."""
        first = bisect.bisect_left(self.records, since_s, key=lambda r: r.stamp_s)
        records = self.records[first:]
        if not records:
            return np.zeros(0), np.zeros((0, 4, 4))
        with self.map.lock:
            T_k_w = {id: self.map.pose_of(id) for id in {r.keyframe_id for r in records}}
        T_c_w = np.stack([r.T_c_k for r in records]) @ np.stack([T_k_w[r.keyframe_id] for r in records])
        return np.array([r.stamp_s for r in records]), se3.inverse(T_c_w)
