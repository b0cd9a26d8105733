"""ORB keypoints spread evenly over the image (Rublee et al., ICCV 2011)."""

import math
import threading
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.config import OrbConfig
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

CANDIDATES = 1500
"""Minimum number of corners that are detected before they are spread evenly."""
MIN_EIGENVALUE_RATIO = 0.1
"""Of the structure tensor around a keypoint. On a straight edge it is smaller: a keypoint slides along the edge, by
several pixels on the joints of bare walls, and what it slides by looks like motion (Lowe, IJCV 2004, section 4.1)."""
_WINDOW = 5
"""Half width of the structure tensor's window [px of the keypoint's octave]."""
_BLUR_PX = 1.0
"""Smoothing before: the stairs of a slanted line would be corners."""
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
        found, kept = self._best(grey, np.asarray(cv2.GaussianBlur(grey, (5, 5), _BLUR_PX), dtype=np.uint8))
        keep = kept[spread(found.uv[kept], found.score[kept], grey.shape[1], grey.shape[0], self.config.features)]
        return FrameFeatures(
            uv=self.camera.undistort_points(found.uv[keep]),
            octave=found.octave[keep],
            angle_rad=found.angle_rad[keep],
            descriptors=found.descriptors[keep],
            faint=found.faint,
        )

    def _best(self, grey: NDArray[np.uint8], smooth: NDArray[np.uint8]) -> tuple["_Found", IntArray]:
        """Keypoints and which to use: corners, faint ones too where there are few (bare walls, low light); all where
        there are too few of those, as those on edges are better than none."""
        enough, least = FAINT_SHARE * self.config.features, CORNER_SHARE * self.config.features
        clear = self._found(grey, faint=False)
        corner = clear.corners(smooth, self.config.scale_factor)
        if len(corner) >= enough:
            return clear, corner
        faint = self._found(grey, faint=True)
        corner = faint.corners(smooth, self.config.scale_factor)
        if len(corner) >= least:
            return faint, corner
        found = clear if len(clear.uv) >= enough else faint
        return found, np.arange(len(found.uv))

    def _found(self, grey: NDArray[np.uint8], faint: bool) -> "_Found":
        # All candidates are described, in one call: a second call would build the image pyramid again.
        with self._one_at_a_time:
            found, descriptors = self._detectors[faint].detectAndCompute(grey, None)
        octave = np.array([k.octave for k in found], dtype=np.int32)
        pixel = np.array(cv2.KeyPoint.convert(found)).reshape(-1, 2)
        return _Found(
            uv=_in_image(pixel, octave, self.config.scale_factor, grey.shape[::-1]),
            octave=octave,
            angle_rad=np.deg2rad(np.array([k.angle for k in found], dtype=np.float32)),
            score=np.array([k.response for k in found], dtype=np.float32),
            descriptors=np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, dtype=np.uint8),
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
    faint: bool

    def corners(self, smooth: NDArray[np.uint8], scale_factor: float) -> IntArray:
        """Those that are corners."""
        ratio = _eigenvalue_ratio(smooth, self.uv, scale_factor ** self.octave.astype(np.float64))
        return np.flatnonzero(ratio > MIN_EIGENVALUE_RATIO)


@compiled("u1[:,::1], f4[:,::1], f8[::1]")
def _eigenvalue_ratio(grey: NDArray[np.uint8], uv: FloatArray, scale: FloatArray) -> FloatArray:
    """Smaller by larger eigenvalue ``(N,)`` of the structure tensor: 0 on a straight edge, 1 on an isotropic corner.

    Args:
        grey: Smoothed image ``(H, W)``.
        uv: Keypoints ``(N, 2)``.
        scale: ``(N,)`` of their octaves, the distance of samples [px].
    """
    height, width = grey.shape
    ratio = np.zeros(len(uv))
    for n in range(len(uv)):
        a, b, c, step = 0.0, 0.0, 0.0, scale[n]
        for i in range(-_WINDOW, _WINDOW + 1):
            above = min(max(int(uv[n, 1] + (i - 1) * step + 0.5), 0), height - 1)
            at = min(max(int(uv[n, 1] + i * step + 0.5), 0), height - 1)
            below = min(max(int(uv[n, 1] + (i + 1) * step + 0.5), 0), height - 1)
            for j in range(-_WINDOW, _WINDOW + 1):
                left = min(max(int(uv[n, 0] + (j - 1) * step + 0.5), 0), width - 1)
                here = min(max(int(uv[n, 0] + j * step + 0.5), 0), width - 1)
                right = min(max(int(uv[n, 0] + (j + 1) * step + 0.5), 0), width - 1)
                x = float(grey[at, right]) - float(grey[at, left])
                y = float(grey[below, here]) - float(grey[above, here])
                a += x * x
                b += x * y
                c += y * y
        spread = math.sqrt((a - c) * (a - c) + 4.0 * b * b)
        ratio[n] = (a + c - spread) / max(a + c + spread, 1.0)
    return ratio


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
