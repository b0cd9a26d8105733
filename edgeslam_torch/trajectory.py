"""Poses of all frames, each tied to a keyframe so that it moves when the map is refined."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
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

    def replace(self, T_c_w_of_frame: dict[int, FloatArray], keyframe_id: int) -> None:
        """Give recent frames, by index, new poses."""
        T_w_k = se3.inverse(self.map.pose_of(keyframe_id))
        for record in reversed(self.records):
            if record.index not in T_c_w_of_frame:
                break
            record.keyframe_id = keyframe_id
            record.T_c_k = T_c_w_of_frame[record.index] @ T_w_k

    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and ``T_w_c`` ``(F, 4, 4)`` in the map as it is now."""
        stamps = np.array([r.stamp_s for r in self.records])
        T = [se3.inverse(r.T_c_k @ self.map.pose_of(r.keyframe_id)) for r in self.records]
        return stamps, np.stack(T) if T else np.zeros((0, 4, 4))
