"""Poses of all frames, each tied to a keyframe so that it moves when the map is refined."""

import bisect
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrices_from_vectors, vectors_from_matrices
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, Piece, Support

_THE_SAME = 1e-9
_STEP = 1e-9
"""Least way from one frame to the next [map units]: a change is distributed evenly over frames without motion."""


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
    T_c_before: FloatArray | None = None
    """``(4, 4)`` pose of a new keyframe as tracked, before refinement, relative to the previous frame's keyframe."""


class TrajectoryLog:
    """Every frame stepped so far."""

    def __init__(self, slam_map: SlamMap) -> None:
        self.map = slam_map
        self.records: list[FrameRecord] = []

    def append(
        self,
        index: int,
        stamp_s: float,
        keyframe_id: int,
        T_c_w: FloatArray,
        supported: bool,
        T_c_before: FloatArray | None = None,
    ) -> None:
        """Record a frame's pose in the map as it is now, and whether the map supports it.

        Args:
            index: Of the frame.
            stamp_s: Its stamp.
            keyframe_id: Keyframe that it is tied to.
            T_c_w: Its pose ``(4, 4)``.
            supported: Whether the map supports it.
            T_c_before: For a new keyframe, what `relative_to_last` gave before refinement.
        """
        with self.map.lock:
            T_c_k = T_c_w @ se3.inverse(self.map.pose_of(keyframe_id))
        self.records.append(FrameRecord(index, stamp_s, keyframe_id, T_c_k, supported, T_c_before))

    def relative_to_last(self, T_c_w: FloatArray) -> FloatArray | None:
        """A tracked pose ``(4, 4)`` relative to the keyframe that the last frame is tied to; None without a frame."""
        if not self.records:
            return None
        with self.map.lock:
            return T_c_w @ se3.inverse(self.map.pose_of(self.records[-1].keyframe_id))

    def replace(self, T_c_w_of_frame: dict[int, FloatArray], keyframes: list[Keyframe]) -> None:
        """Give recent frames, by index, new poses that the map supports.

        Each is tied to the last of the keyframes (in order) before it.
        """
        indices = [k.frame_index for k in keyframes]
        left = dict(T_c_w_of_frame)
        for record in reversed(self.records):
            if not left:
                break
            T_c_w = left.pop(record.index, None)
            if T_c_w is None:
                continue
            keyframe = keyframes[max(bisect.bisect_right(indices, record.index) - 1, 0)]
            record.keyframe_id = keyframe.id
            record.T_c_k = T_c_w @ keyframe.T_w_c
            record.supported = True

    def scale(self, scale_of: dict[int, float]) -> None:
        """Rescale relative poses of frames to keyframes whose surroundings were scaled, by their ids."""
        before = None
        for record in self.records:
            grown = scale_of.get(self.map.resolve(record.keyframe_id)[0], 1.0)
            if record.T_c_before is not None:
                record.T_c_before = se3.scaled(record.T_c_before, grown if before is None else before)
            record.T_c_k = se3.scaled(record.T_c_k, grown)
            before = grown

    def support(self) -> Support:
        """Support of each frame's pose in the present map."""
        with self.map.lock:
            piece_of = {id: self.map.piece_of(id) for id in {r.keyframe_id for r in self.records}}
        piece = np.array([piece_of[r.keyframe_id] for r in self.records], dtype=np.int64)
        return Support(piece, np.array([r.supported for r in self.records], dtype=bool))

    def pieces(self) -> list[Piece]:
        """Submaps of the frames in the present map, in the order of their numbers."""
        support = self.support()
        stamps = np.array([r.stamp_s for r in self.records])
        pieces = []
        for number in np.unique(support.piece):
            mine = np.flatnonzero(support.piece == number)
            supported = int(support.supported[mine].sum())
            begun = self.map.begun.get(int(number), "")
            pieces.append(Piece(int(number), len(mine), supported, stamps[mine[0]], stamps[mine[-1]], begun))
        return pieces

    def warning(self) -> str | None:
        """Warning that submaps were never merged; None for a single one."""
        pieces = [p for p in self.pieces() if p.supported > 0]
        if len(pieces) < 2:
            return None
        began_s = self.records[0].stamp_s
        spans = ", ".join(f"{p.number} ({p.first_s - began_s:.1f} to {p.last_s - began_s:.1f} s)" for p in pieces)
        return f"the map is in {len(pieces)} pieces that were never joined, {spans}: poses across them do not relate"

    def poses(self, since_s: float = -math.inf, count: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and ``T_w_c`` ``(F, 4, 4)`` in the map as it is now, of frames not older than ``since_s``, at
        most the first ``count``."""
        first = bisect.bisect_left(self.records, since_s, key=lambda r: r.stamp_s)
        records = self.records[first:][:count]
        if not records:
            return np.zeros(0), np.zeros((0, 4, 4))
        with self.map.lock:
            T_k_w = {id: self.map.pose_of(id) for id in {r.keyframe_id for r in records}}
        T_c_k = np.stack([r.T_c_k for r in records])
        T_c_w = T_c_k @ np.stack([T_k_w[r.keyframe_id] for r in records])
        _close_gaps(records, T_c_w, T_k_w, np.abs(T_c_k - np.eye(4)).max(axis=(1, 2)) < _THE_SAME)
        return np.array([r.stamp_s for r in records]), se3.inverse(T_c_w)


def _close_gaps(
    records: list[FrameRecord], T_c_w: FloatArray, T_k_w: dict[int, FloatArray], own: NDArray[np.bool_]
) -> None:
    """Distribute a refinement's change between two keyframes over the frames in between by the way, in place.

    A frame keeps its tracked pose relative to its keyframe. After a refinement of the next keyframe, the error of
    frames would grow towards it, with a jump at it.

    Args:
        records: Of consecutive frames.
        T_c_w: Their poses ``(F, 4, 4)`` by their own keyframes.
        T_k_w: World-to-camera pose of each keyframe.
        own: Whether a frame is the reference keyframe itself ``(F,)``; the first ones of a map were not tracked before.
    """
    begin, gaps, before = 0, [], []
    for i, record in enumerate(records):
        if record.T_c_before is None:
            begin = i if own[i] else begin
            continue
        observed = records[begin].keyframe_id  # frames tied to another one need not be right where that one begins
        if i - begin > 1 and all(r.supported and r.keyframe_id == observed for r in records[begin:i]):
            gaps.append((begin, i))
            before.append(record.T_c_before @ T_k_w[records[i - 1].keyframe_id])
        begin = i
    if not gaps:
        return
    (first, end), tracked = np.array(gaps).T, np.stack(before)
    centre, last = (se3.inverse(T)[:, :3, 3] for T in (T_c_w, tracked))
    step = np.linalg.norm(np.diff(centre, axis=0, prepend=centre[:1]), axis=1) + _STEP
    so_far = np.cumsum(step)
    whole = so_far[end - 1] - so_far[first] + np.linalg.norm(last - centre[end - 1], axis=1) + _STEP
    gap = np.repeat(np.arange(len(gaps)), end - first - 1)
    frame = np.concatenate([np.arange(i + 1, j) for i, j in gaps])
    share = ((so_far[frame] - so_far[first[gap]]) / whole[gap])[:, None]
    moved = T_c_w[end] @ se3.inverse(tracked)
    change = np.tile(np.eye(4), (len(frame), 1, 1))
    change[:, :3, :3] = matrices_from_vectors(share * vectors_from_matrices(moved[:, :3, :3])[gap])
    change[:, :3, 3] = share * moved[gap, :3, 3]
    T_c_w[frame] = change @ T_c_w[frame]
