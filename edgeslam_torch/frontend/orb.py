"""ORB keypoints spread evenly over the image (Rublee et al., ICCV 2011)."""

import threading
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.frontend.aperture import are_corners
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

CANDIDATES = 1500
"""Minimum number of corners that are detected before they are spread evenly."""
FAINT_SHARE = 0.5
"""Number of corners, relative to the requested keypoints, below which the image is searched again for fainter ones."""
CORNER_SHARE = 0.3
"""That below which keypoints on edges are used, too."""


class OrbExtractor:
    """Detects and describes more keypoints than requested; of those that are corners, keeps the best of every cell."""

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
        found = self._found(grey)
        use = (
            np.arange(len(found.uv))
            if found.corners < CORNER_SHARE * self.config.features
            else np.flatnonzero(found.corner)
        )
        keep = use[spread(found.uv[use], found.score[use], grey.shape[1], grey.shape[0], self.config.features)]
        return FrameFeatures(
            uv=self.camera.undistort_points(found.uv[keep]),
            octave=found.octave[keep],
            angle_rad=found.angle_rad[keep],
            descriptors=found.descriptors[keep],
            corner=found.corner[keep],
            faint=found.faint,
        )

    def _found(self, grey: NDArray[np.uint8]) -> "_Found":
        """Keypoints, faint ones too where there are few clear corners: bare walls, low light."""
        enough = FAINT_SHARE * self.config.features
        clear = self._detected(grey, faint=False)
        if clear.corners >= enough:
            return clear
        faint = self._detected(grey, faint=True)
        too_few = faint.corners < CORNER_SHARE * self.config.features
        return clear if too_few and len(clear.uv) >= enough else faint

    def _detected(self, grey: NDArray[np.uint8], faint: bool) -> "_Found":
        # All candidates are described, in one call: a second call would build the image pyramid again.
        with self._one_at_a_time:
            found, descriptors = self._detectors[faint].detectAndCompute(grey, None)
        octave = np.array([k.octave for k in found], dtype=np.int32)
        pixel = np.array(cv2.KeyPoint.convert(found)).reshape(-1, 2)
        uv = _in_image(pixel, octave, self.config.scale_factor, grey.shape[::-1])
        return _Found(
            uv=uv,
            octave=octave,
            angle_rad=np.deg2rad(np.array([k.angle for k in found], dtype=np.float32)),
            score=np.array([k.response for k in found], dtype=np.float32),
            descriptors=np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, dtype=np.uint8),
            corner=are_corners(grey, uv, self.config.scale_factor ** octave.astype(np.float64)),
            faint=faint,
        )


@dataclass(frozen=True, slots=True)
class _Found:
    """Detected keypoints."""

    uv: FloatArray
    octave: IntArray
    angle_rad: FloatArray
    score: FloatArray
    descriptors: NDArray[np.uint8]
    corner: NDArray[np.bool_]
    """``(N,)`` Whether they lie on corners; the others lie on straight edges."""
    faint: bool

    @property
    def corners(self) -> int:
        """Number of corners."""
        return int(self.corner.sum())


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
