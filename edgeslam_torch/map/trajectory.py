"""Poses of all frames, each tied to a keyframe so that it moves when the map is refined."""

import bisect
import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, Piece, Support


@dataclass(slots=True)
class FrameRecord:
    """One frame's pose relative to a keyframe."""

    index: int
    stamp_s: float
    keyframe_id: int
    T_c_k: FloatArray
    """``(4, 4)``"""
    supported: bool
    """Whether the pose rests on a map that the images support."""


class TrajectoryLog:
    """Every frame stepped so far."""

    def __init__(self, slam_map: SlamMap) -> None:
        self.map = slam_map
        self.records: list[FrameRecord] = []

    def append(self, index: int, stamp_s: float, keyframe_id: int, T_c_w: FloatArray, supported: bool) -> None:
        """Record a frame's pose in the map as it is now, and whether the map supports it."""
        with self.map.lock:
            T_c_k = T_c_w @ se3.inverse(self.map.pose_of(keyframe_id))
        self.records.append(FrameRecord(index, stamp_s, keyframe_id, T_c_k, supported))

    def replace(self, T_c_w_of_frame: dict[int, FloatArray], keyframes: list[Keyframe]) -> None:
        """Give recent frames, by index, new poses that the map supports.

        Each is tied to the last of the keyframes (in order) before it.
        """
        indices = [k.frame_index for k in keyframes]
        for record in reversed(self.records):
            if record.index not in T_c_w_of_frame:
                break
            keyframe = keyframes[max(bisect.bisect_right(indices, record.index) - 1, 0)]
            record.keyframe_id = keyframe.id
            record.T_c_k = T_c_w_of_frame[record.index] @ keyframe.T_w_c
            record.supported = True

    def support(self) -> Support:
        """What each frame's pose rests on in the map as it is now."""
        with self.map.lock:
            piece_of = {id: self.map.piece_of(id) for id in {r.keyframe_id for r in self.records}}
        piece = np.array([piece_of[r.keyframe_id] for r in self.records], dtype=np.int64)
        return Support(piece, np.array([r.supported for r in self.records], dtype=bool))

    def pieces(self) -> list[Piece]:
        """The pieces that the frames belong to in the map as it is now, in the order of their numbers."""
        support = self.support()
        stamps = np.array([r.stamp_s for r in self.records])
        pieces = []
        for number in np.unique(support.piece):
            mine = np.flatnonzero(support.piece == number)
            supported = int(support.supported[mine].sum())
            begun = self.map.begun.get(int(number), "")
            pieces.append(Piece(int(number), len(mine), supported, stamps[mine[0]], stamps[mine[-1]], begun))
        return pieces

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
