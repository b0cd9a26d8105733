"""ORB keypoints spread evenly over the image (Rublee et al., ICCV 2011)."""

import threading

import cv2
import numpy as np

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

FAINT_SHARE = 0.5
"""Share of the keypoints asked for below which fainter corners are looked for as well."""


class OrbExtractor:
    """Detects more corners than asked for, keeps the best of every cell, describes those."""

    def __init__(self, config: OrbConfig, camera: Camera) -> None:
        self.config = config
        self.camera = camera
        self._detectors = [self._detector(threshold) for threshold in (config.fast_threshold, config.fast_faint)]
        self._one_at_a_time = threading.Lock()  # OpenCV does not say that two threads may share a detector

    def _detector(self, fast_threshold: int) -> cv2.ORB:
        return cv2.ORB.create(
            nfeatures=self.config.candidates,
            scaleFactor=self.config.scale_factor,
            nlevels=self.config.levels,
            fastThreshold=fast_threshold,
        )

    def __call__(self, grey: np.ndarray) -> FrameFeatures:
        """Features of a grey image ``(H, W)`` uint8 with the lens distortion still in it."""
        # All candidates are described, in one call: a second one would build the image pyramid again.
        with self._one_at_a_time:
            for detector in self._detectors:  # the faint ones only where there is little else: bare walls, little light
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
        )


def _in_image(uv: FloatArray, octave: IntArray, scale_factor: float, size: tuple[int, int]) -> FloatArray:
    """Pixels of the image where OpenCV found keypoints ``(N, 2)`` on the images of its pyramid.

    It multiplies by the scale alone: half a pixel of the level is left out, and that a level's size is a whole number.
    """
    scale = scale_factor ** octave[:, None].astype(np.float64)
    whole = np.array(size, dtype=np.float64)
    on_level = uv / scale
    uv0: FloatArray = ((on_level + 0.5) * (whole / np.rint(whole / scale)) - 0.5).astype(np.float32)
    return uv0


def spread(uv: FloatArray, score: FloatArray, width: int, height: int, wanted: int) -> IntArray:
    """Indices of about ``wanted`` keypoints, the strongest of every image cell first.

    Cells are taken in rounds: every cell gives its best corner, then its second best, and so on, until there are
    enough; within the last round the strongest win. Weakly textured parts of the image keep their few corners,
    which hold the pose in rotation and depth.
    """
    if len(uv) <= wanted:
        return np.arange(len(uv))
    side = np.sqrt(width * height / wanted * 4.0)  # four corners to a cell on average
    columns = int(np.ceil(width / side))
    cell = (uv[:, 1] // side).astype(np.int64) * columns + (uv[:, 0] // side).astype(np.int64)
    order = np.lexsort((-score, cell))
    sorted_cell = cell[order]
    starts = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    rank_in_cell = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    best_first = np.lexsort((-score[order], rank_in_cell))[:wanted]
    return np.sort(order[best_first])
