"""ORB keypoints spread evenly over the image (Rublee et al., ICCV 2011)."""

import threading

import cv2
import numpy as np

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

CANDIDATES = 1500
"""Minimum number of corners that are detected before they are spread evenly."""
FAINT_SHARE = 0.5
"""Share of the requested keypoints below which the image is searched again for fainter corners."""


class OrbExtractor:
    """Detects more corners than requested, keeps the best of every cell, and describes those."""

    def __init__(self, config: OrbConfig, camera: Camera) -> None:
        self.config = config
        self.camera = camera
        self._detectors = [self._detector(threshold) for threshold in (config.fast_threshold, config.fast_faint)]
        self._one_at_a_time = threading.Lock()  # OpenCV does not document detectors as thread-safe

    def _detector(self, fast_threshold: int) -> cv2.ORB:
        return cv2.ORB.create(
            nfeatures=max(CANDIDATES, self.config.features),
            scaleFactor=self.config.scale_factor,
            nlevels=self.config.levels,
            fastThreshold=fast_threshold,
        )

    def __call__(self, grey: np.ndarray) -> FrameFeatures:
        """Features of a grey image ``(H, W)`` uint8 with the lens distortion still in it."""
        # All candidates are described, in one call: a second call would build the image pyramid again.
        with self._one_at_a_time:
            for detector in self._detectors:  # faint corners only where there are few others: bare walls, low light
                found, descriptors = detector.detectAndCompute(grey, None)
                if len(found) >= FAINT_SHARE * self.config.features:
                    break
        if not found or descriptors is None:
            return FrameFeatures(
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.int32),
                np.zeros(0, np.float32),
                np.zeros((0, 32), np.uint8),
            )
        octave = np.array([k.octave for k in found])
        uv = _in_image(np.array(cv2.KeyPoint.convert(found)), octave, self.config.scale_factor, grey.shape[::-1])
        score = np.array([k.response for k in found], dtype=np.float32)
        keep = spread(uv, score, grey.shape[1], grey.shape[0], self.config.features)
        kept = [found[i] for i in keep]
        return FrameFeatures(
            uv=self.camera.undistort_points(uv[keep]),
            octave=np.array([k.octave for k in kept], dtype=np.int32),
            angle_rad=np.deg2rad(np.array([k.angle for k in kept], dtype=np.float32)),
            descriptors=np.asarray(descriptors, dtype=np.uint8)[keep],
            faint=detector is not self._detectors[0],
        )


def _in_image(uv: FloatArray, octave: IntArray, scale_factor: float, size: tuple[int, int]) -> FloatArray:
    """Image pixels of the keypoints ``(N, 2)`` that OpenCV detects on its pyramid levels.

    OpenCV only multiplies by the scale; this adds the half-pixel offset of the level and the rounding of its size.
    """
    scale = scale_factor ** octave[:, None].astype(np.float64)
    whole = np.array(size, dtype=np.float64)
    on_level = uv / scale
    uv0: FloatArray = ((on_level + 0.5) * (whole / np.rint(whole / scale)) - 0.5).astype(np.float32)
    return uv0


def spread(uv: FloatArray, score: FloatArray, width: int, height: int, wanted: int) -> IntArray:
    """Indices of about ``wanted`` keypoints, the strongest of every image cell first.

    Cells are visited in rounds: each contributes its best corner, then its second best, and so on, until there are
    enough; in the last round the strongest win. Weakly textured regions keep their few corners, which constrain
    rotation and depth.
    """
    if len(uv) <= wanted:
        return np.arange(len(uv))
    side = np.sqrt(width * height / wanted * 4.0)  # four corners per cell on average
    columns = int(np.ceil(width / side))
    cell = (uv[:, 1] // side).astype(np.int64) * columns + (uv[:, 0] // side).astype(np.int64)
    order = np.lexsort((-score, cell))
    sorted_cell = cell[order]
    starts = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    rank_in_cell = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    best_first = np.lexsort((-score[order], rank_in_cell))[:wanted]
    return np.sort(order[best_first])
