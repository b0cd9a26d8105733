"""A keyframe: features, their anchors, and the pose that refinement moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import DepthMap, FloatArray, FrameFeatures, IntArray

NO_ANCHOR = -1


@dataclass(slots=True)
class Keyframe:
    """One node of the map."""

    id: int
    frame_index: int
    stamp_s: float
    T_c_w: FloatArray
    """``(4, 4)`` world to camera."""
    features: FrameFeatures
    anchor: IntArray
    """``(N,)`` anchor of each keypoint, `NO_ANCHOR` where it has none."""
    words: NDArray[np.uint64]
    """``(N, 4)`` descriptors for `hamming`."""
    grid: KeypointGrid
    """Index of ``features.uv``."""
    depth: DepthMap | None = None
    """Released, like ``image``, after the edges are measured."""
    image: NDArray[np.uint8] | None = None
    """Undistorted, ``(H, W, 3)`` BGR or ``(H, W)`` grey; for edges."""
    grey: NDArray[np.uint8] | None = None
    """``(H, W)`` undistorted, searched for other keyframes' edges."""

    @property
    def T_w_c(self) -> FloatArray:
        """``(4, 4)`` camera to world."""
        return se3.inverse(self.T_c_w)

    @property
    def centre_w(self) -> FloatArray:
        """``(3,)`` camera centre."""
        return -self.T_c_w[:3, :3].T @ self.T_c_w[:3, 3]

    def keypoints_with_anchor(self) -> IntArray:
        """Indices of keypoints that have an anchor."""
        return np.flatnonzero(self.anchor >= 0)


def make_keyframe(id: int, frame_index: int, stamp_s: float, T_c_w: FloatArray, features: FrameFeatures) -> Keyframe:
    """Keyframe without anchors."""
    return Keyframe(
        id=id,
        frame_index=frame_index,
        stamp_s=stamp_s,
        T_c_w=T_c_w.copy(),
        features=features,
        anchor=np.full(len(features.uv), NO_ANCHOR, dtype=np.int64),
        words=words(features.descriptors),
        grid=KeypointGrid(features.uv),
    )
