"""A keyframe: features, their anchors, and the pose that refinement moves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import DepthMap, FloatArray, FrameFeatures, IntArray

NO_ANCHOR = -1

SHARED_ERRORS = 3.0
"""Factor on the standard deviation of a tracked motion: neighbouring keyframes share the errors of their corners and of
the depth network, which its covariance takes for independent."""


@dataclass(frozen=True, slots=True)
class TrackedMotion:
    """Tracked motion from a reference keyframe to another one."""

    reference_id: int
    T_c_r: FloatArray
    """``(4, 4)``, takes coordinates of the reference to the keyframe."""
    information: FloatArray
    """``(6, 6)`` inverse covariance of its left tangent."""

    def scaled(self, scale: float) -> "TrackedMotion":
        """The same after a change of the map's scale."""
        by = np.array([1.0 / scale] * 3 + [1.0] * 3)
        return replace(self, T_c_r=se3.scaled(self.T_c_r, scale), information=self.information * np.outer(by, by))


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
    """Index of ``features.uv`` as they were detected."""
    aligned_px: FloatArray
    """``(N,)`` standard deviation [px] of keypoints that are aligned with other views (`sub_pixel.align`); NaN for
    corners as they were detected."""
    depth: DepthMap | None = None
    """Released, like ``image``, after the edges are measured."""
    network_m: FloatArray | None = None
    """``(N,)`` network depth at the keypoints [m], NaN where it is undefined; kept when ``depth`` is released."""
    tracked: TrackedMotion | None = None
    """Set if most of its depths rested on priors at creation."""
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

    def scale(self, scale: float) -> None:
        """Rescale stored distances after a change of the map's scale, except for the pose."""
        self.tracked = None if self.tracked is None else self.tracked.scaled(scale)

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
        aligned_px=np.full(len(features.uv), np.nan),
    )


def tracked_motion(reference: Keyframe, T_c_w: FloatArray, covariance: FloatArray) -> TrackedMotion | None:
    """Tracked motion from a keyframe to a camera; None without an invertible covariance ``(6, 6)``."""
    if not np.isfinite(covariance).all() or np.linalg.matrix_rank(covariance, hermitian=True) < 6:
        return None
    return TrackedMotion(reference.id, T_c_w @ reference.T_w_c, np.linalg.inv(SHARED_ERRORS**2 * covariance))
