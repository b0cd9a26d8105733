"""Calibration of a ``CameraInfo`` message."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.lens import check_camera
from edgeslam_torch.types import FloatArray

_MAX_MISFIT_PX = 0.3
"""Another lens model is replaced by ours if no pixel of the image moves by more; a keypoint is located to about 0.5."""
_MAX_INVERSE_PX = 5.0
"""How far from a pixel OpenCV's inverse may end; beyond, the corners are not covered."""
_GRID = 25
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4")
_BROWN = ("plumb_bob", "radtan", "brown_conrady", "radial-tangential", "none", "")


def camera_from_info(info: Any, name: str, rectified: bool) -> Camera | None:
    """Camera of the pictures; None if the driver sent an empty calibration.

    Args:
        info: ``sensor_msgs/CameraInfo`` of either version of ROS.
        name: File and topic, for messages.
        rectified: Whether the pictures are rectified, so that the projection ``P`` applies and no distortion.

    Raises:
        CalibrationError: If it describes no camera, a part of an image, or a lens that our model cannot express.
    """
    K = np.asarray(info.k if hasattr(info, "k") else info.K, dtype=np.float64).reshape(3, 3)
    P = np.asarray(info.p if hasattr(info, "p") else info.P, dtype=np.float64).reshape(3, 4)
    D = [float(x) for x in (info.d if hasattr(info, "d") else info.D)]
    if rectified and P[0, 0] > 0:
        K, D = P[:, :3], []
    if K[0, 0] == 0:
        return None
    if _is_part(info):
        raise CalibrationError(f"{name}: calibration of a part of the image (roi, binning); give --camera FILE")
    size = (int(info.width), int(info.height))
    K_numbers = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    try:
        distortion = _five(str(info.distortion_model).lower(), D, K, size)
        camera = Camera(*size, *K_numbers, distortion, source=name)
        check_camera(camera)
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}; give --camera FILE") from error
    return camera


def _is_part(info: Any) -> bool:
    roi = info.roi
    cut = roi.x_offset or roi.y_offset or (roi.width not in (0, info.width)) or (roi.height not in (0, info.height))
    return bool(cut) or info.binning_x > 1 or info.binning_y > 1


def _five(model: str, D: Sequence[float], K: FloatArray, size: tuple[int, int]) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3 of any of ROS's models."""
    if not any(D):
        return (0.0,) * 5
    if model in _FISHEYE and len(D) == 4:
        pixels = _pixels(size)
        rays: FloatArray = np.asarray(cv2.fisheye.undistortPoints(pixels, K, np.array(D)), np.float64).reshape(-1, 2)
        return _fitted(model, rays, pixels.reshape(-1, 2), K)
    if len(D) <= 5 and model in _BROWN:
        return (*D, *([0.0] * (5 - len(D))))
    if model in ("rational_polynomial", "plumb_bob", "thin_prism") and len(D) in (8, 12, 14):
        if not any(D[5:]):
            return tuple(D[:5])
        pixels = _pixels(size)
        rays = np.asarray(cv2.undistortPoints(pixels, K, np.array(D)), np.float64).reshape(-1, 2)
        still = np.zeros(3)
        # OpenCV inverts the model with a few iterations: what it found is fitted where it truly lies.
        there, _ = cv2.projectPoints(np.hstack([rays, np.ones((len(rays), 1))]), still, still, K, np.array(D))
        if not np.abs(there - pixels).max() < _MAX_INVERSE_PX:
            raise CalibrationError(f"a {model} lens of such a wide view is not supported, only plumb_bob")
        return _fitted(model, rays, np.asarray(there, np.float64).reshape(-1, 2), K)
    raise CalibrationError(f"lens model {model[:40]!r} with {len(D)} numbers is not supported")


def _pixels(size: tuple[int, int]) -> FloatArray:
    """Pixels ``(N, 1, 2)`` all over the image."""
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, _GRID), np.linspace(0, size[1] - 1, _GRID))
    return np.stack([u.ravel(), v.ravel()], axis=1)[:, None]


def _fitted(model: str, rays: FloatArray, pixels: FloatArray, K: FloatArray) -> tuple[float, ...]:
    """Our five numbers for points ``rays`` ``(N, 2)`` of the plane z = 1 that another model sees at ``pixels``.

    The distorted position is linear in the five.

    Raises:
        CalibrationError: If some pixel is missed by more than `_MAX_MISFIT_PX`.
    """
    focal = np.array([K[0, 0], K[1, 1]])
    seen = (pixels - [K[0, 2], K[1, 2]]) / focal
    if not np.isfinite(rays).all() or np.abs(rays).max() > 1e3:
        raise CalibrationError(f"a {model} lens of such a wide view is not supported, only plumb_bob")
    x, y = rays.T
    s = x * x + y * y
    columns_x = np.stack([x * s, x * s**2, 2 * x * y, s + 2 * x * x, x * s**3], axis=1)
    columns_y = np.stack([y * s, y * s**2, s + 2 * y * y, 2 * x * y, y * s**3], axis=1)
    rows = np.concatenate([columns_x, columns_y])
    coefficients = np.linalg.lstsq(rows, (seen - rays).T.ravel(), rcond=None)[0]
    left = (rows @ coefficients).reshape(2, -1).T + rays - seen
    misfit_px = float(np.linalg.norm(left * focal, axis=1).max())
    if misfit_px > _MAX_MISFIT_PX:
        raise CalibrationError(
            f"a {model} lens whose best plumb_bob is up to {misfit_px:.1f} px off is not supported; rectify the images"
        )
    return tuple(float(k) for k in coefficients)
