"""Pinhole camera with Brown-Conrady distortion, and presets."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.types import FloatArray

GUESSED_FOCAL_SIGMA = 0.45
"""Relative standard deviation of guessing 1.2 times the longer side: the RMS of log(guess / calibrated) is 0.47 over
nine cameras with 0.5 to 0.96 times their longer side."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of one camera [px]; pixel centres at integers.

    Example:
        >>> camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
        >>> camera.back_project(np.array([[420.0, 190.0]]), np.array([2.0]))
        array([[ 0.4, -0.2,  2. ]])
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 k3, in OpenCV's order."""
    source: str = "given"
    """Origin of the calibration; part of every summary."""
    focal_sigma: float = 0.0
    """Relative standard deviation of the focal lengths; 0 for a calibration, whose error is negligible relative to the
    scale's."""

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion, self.focal_sigma)
        if self.width <= 0 or self.height <= 0 or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"image size and focal lengths must be positive: {self}")
        if not np.all(np.isfinite(numbers)):
            raise CalibrationError(f"calibration holds a number that is not finite: {self}")
        if not 0 <= self.focal_sigma <= 1:
            raise CalibrationError(f"focal_sigma must be at least 0 and at most 1, got {self.focal_sigma:g}")

    @property
    def K(self) -> FloatArray:
        """Calibration matrix [px], shape ``(3, 3)``, float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(k != 0.0 for k in self.distortion)

    def scaled(self, width: int, height: int) -> "Camera":
        """The same lens on an image resized to ``width x height`` (pixel centres at integers)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def undistort_points(self, uv: FloatArray) -> FloatArray:
        """Undistorted pixels ``(N, 2)`` of distorted ones."""
        if not self.is_distorted or len(uv) == 0:
            return np.asarray(uv, dtype=np.float32)
        points = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 1, 2)
        return (
            cv2.undistortPoints(points, self.K, np.array(self.distortion), P=self.K).reshape(-1, 2).astype(np.float32)
        )

    def distort_points(self, uv: FloatArray) -> FloatArray:
        """Distorted pixels ``(N, 2)`` of undistorted ones; inverse of `undistort_points`."""
        if not self.is_distorted or len(uv) == 0:
            return np.asarray(uv, dtype=np.float32)
        return self.project_through_lens(self.back_project(uv, np.ones(len(uv))))

    def undistort_image(self, image: np.ndarray) -> np.ndarray:
        """Image resampled to the undistorted pinhole camera of the same ``K``."""
        if not self.is_distorted:
            return image
        return cv2.remap(image, *self.undistortion_maps(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def undistortion_maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Fixed-point maps for `cv2.remap` from the distorted to the undistorted image; cached per camera."""
        return _undistortion_maps(self)

    def back_project(self, uv: FloatArray, depth_m: FloatArray) -> FloatArray:
        """Points ``(N, 3)`` in the camera frame of undistorted pixels ``(N, 2)`` at z-depth ``(N,)``, eq. (17)."""
        uv, z = np.asarray(uv, dtype=np.float64), np.asarray(depth_m, dtype=np.float64)
        x = (uv[:, 0] - self.cx) / self.fx * z
        y = (uv[:, 1] - self.cy) / self.fy * z
        return np.stack([x, y, z], axis=1)

    def project(self, p_c: FloatArray) -> FloatArray:
        """Undistorted pixels ``(N, 2)`` of camera-frame points ``(N, 3)``, paper eq. (1); callers mask ``z <= 0``."""
        z = p_c[:, 2]
        return np.stack([self.fx * p_c[:, 0] / z + self.cx, self.fy * p_c[:, 1] / z + self.cy], axis=1)

    def project_through_lens(self, p_c: FloatArray) -> FloatArray:
        """Distorted pixels ``(N, 2)`` of camera-frame points ``(N, 3)``, float32; callers mask ``z <= 0``."""
        if not self.is_distorted or len(p_c) == 0:
            return self.project(p_c).astype(np.float32)
        still = np.zeros(3)
        pixels, _ = cv2.projectPoints(p_c, still, still, self.K, np.array(self.distortion))
        return np.asarray(pixels, dtype=np.float32).reshape(-1, 2)


@lru_cache(maxsize=4)
def _undistortion_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    size = (camera.width, camera.height)
    K = camera.K
    maps = cv2.initUndistortRectifyMap(K, np.array(camera.distortion), None, K, size, cv2.CV_16SC2)
    for array in maps:
        array.setflags(write=False)  # shared by all callers
    return maps[0], maps[1]


PRESETS = {
    # https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
    "tum_fr1": Camera(
        640, 480, 517.306408, 516.469215, 318.643040, 255.313989, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
    ),
    "tum_fr2": Camera(
        640, 480, 520.908620, 521.007327, 325.141442, 249.701764, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)
    ),
    "tum_fr3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
    # Median of five measured drones (fx 920-936, fy within 2 px of it, cx 460-509, cy 351-364) at 960x720.
    "tello": Camera(960, 720, 925.0, 925.0, 485.0, 360.0),
    "kinect": Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
}
