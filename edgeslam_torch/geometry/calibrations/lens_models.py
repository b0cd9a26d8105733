"""Lens models of other programs, converted to Brown-Conrady (k1 k2 p1 p2 k3)."""

import re
from collections.abc import Sequence

import cv2
import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.types import FloatArray

BROWN, RATIONAL, FISHEYE, FOV = "plumb_bob", "rational_polynomial", "equidistant", "fov"
INVERSE = "inverse_brown_conrady"
"""RealSense's; supported without distortion only."""
PINHOLE = ""
"""A projection without a specified distortion model."""
NO_LENS = "none"

_NAMES = {
    PINHOLE: "pinhole perspective simplepinhole",
    NO_LENS: "none rectified nodistortion undistorted",
    BROWN: "plumbbob radtan radialtangential brown brownconrady simpleradial radial opencv",
    RATIONAL: "rationalpolynomial rational fullopencv thinprism",
    FISHEYE: "equidistant equi fisheye opencvfisheye kannalabrandt kannalabrandt4 kannalabrandt8 kb4 kb8 "
    "simpleradialfisheye radialfisheye",
    FOV: "fov atan",
    INVERSE: "inversebrownconrady modifiedbrownconrady",
}
_FAMILY = {name: family for family, names in _NAMES.items() for name in names.split()}
_OTHERS = frozenset(
    ("mei", "omni", "omnidirectional", "ds", "doublesphere", "eucm", "ucm", "unified", "thinprismfisheye", "spherical")
    + ("equirectangular", "scaramuzza", "ocam", "ftheta", "polynomial", "division", "radialdivision")
)
"""Models that are not supported."""

_OPENCV = (1, 2, 4, 5, 8, 12, 14)
_COUNTS = {BROWN: _OPENCV, RATIONAL: _OPENCV, PINHOLE: _OPENCV, FISHEYE: (4,), FOV: (1,)}
_MAX_MISFIT_PX = 0.3
"""Maximum pixel error of a fitted lens model; keypoints are localised to about 0.5 px."""
_MAX_INVERSE_PX = 5.0
"""Maximum error of OpenCV's inverse; above, the corners of the image are not covered."""
_GRID = 25


def is_distorting(text: str) -> bool:
    """Whether a name denotes a lens model with distortion, supported or not."""
    name = _plain(text)
    return name in _OTHERS or _FAMILY.get(name, PINHOLE) not in (PINHOLE, NO_LENS)


def family_of(name: str) -> str:
    """The lens model denoted by a name of any program.

    Raises:
        CalibrationError: If it is not supported.
    """
    family = _FAMILY.get(_plain(name))
    if family is None:
        raise CalibrationError(
            f"lens model {name[:40]!r} is not supported, only pinhole with plumb_bob, rational_polynomial, equidistant "
            "or fov; rectify the images"
        )
    return family


def fit_remark(family: str, misfit_px: float) -> str:
    """Remark for the user about a fitted lens model."""
    return f"its {family} lens is replaced by plumb_bob, up to {misfit_px:.2f} px off"


def fov_magnification(omega: float) -> float:
    """Focal length at the image centre relative to that of the FOV model with angle ``omega`` [rad].

    Raises:
        CalibrationError: If no lens has this angle.
    """
    if not 0.0 <= omega < np.pi:
        raise CalibrationError(f"the angle of a {FOV} lens is in radians, from 0 to pi, got {omega:g}")
    return 2.0 * float(np.tan(0.5 * omega)) / omega if omega > 1e-6 else 1.0


def five_numbers(
    family: str, D: Sequence[float], K: FloatArray, size: tuple[int, int]
) -> tuple[tuple[float, ...], float | None]:
    """k1 k2 p1 p2 k3 of a lens, and the maximum error of the fit [px]; None if it is the same model.

    Args:
        family: From `family_of`.
        D: Its coefficients in its own order; of a rational lens in OpenCV's.
        K: Calibration matrix ``(3, 3)`` [px]; that of a FOV lens with its `fov_magnification`.
        size: ``(width, height)`` of the images [px].

    Raises:
        CalibrationError: If the number of coefficients is wrong, or the lens cannot be fitted.
    """
    if family == NO_LENS and any(D):
        raise CalibrationError("it states distortion, and a lens model without any")
    if not D or (family not in (FISHEYE, FOV) and not any(D)):
        return (0.0,) * 5, None
    if not np.isfinite(D).all():
        raise CalibrationError("a distortion coefficient is not finite")
    if family not in _COUNTS:
        raise CalibrationError(f"lens model {family!r} is supported without distortion only; rectify the images")
    if len(D) not in _COUNTS[family]:
        takes = ", ".join(map(str, _COUNTS[family]))
        raise CalibrationError(f"{len(D)} distortion coefficients; {family or 'a pinhole camera'} takes {takes}")
    if family not in (FISHEYE, FOV) and not any(D[5:]):
        return (*D[:5], *([0.0] * (5 - len(D)))), None
    pixels = _pixels(size)
    if family == FISHEYE:
        rays: FloatArray = np.asarray(cv2.fisheye.undistortPoints(pixels, K, np.array(D)), np.float64).reshape(-1, 2)
        return _fitted(family, rays, pixels.reshape(-1, 2), K)
    if family == FOV:
        return _fitted(family, _fov_rays(D[0], pixels.reshape(-1, 2), K), pixels.reshape(-1, 2), K)
    rays = np.asarray(cv2.undistortPoints(pixels, K, np.array(D)), np.float64).reshape(-1, 2)
    still = np.zeros(3)
    # OpenCV's iterative inverse is inexact: the rays are projected again for exact pairs.
    there, _ = cv2.projectPoints(np.hstack([rays, np.ones((len(rays), 1))]), still, still, K, np.array(D))
    if not np.abs(there - pixels).max() < _MAX_INVERSE_PX:
        raise CalibrationError(
            f"its {RATIONAL} lens of such a wide view is not supported, only plumb_bob; rectify the images"
        )
    return _fitted(RATIONAL, rays, np.asarray(there, np.float64).reshape(-1, 2), K)


def _too_wide(model: str) -> CalibrationError:
    return CalibrationError(f"its {model} lens of such a wide view is not supported by plumb_bob; rectify the images")


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _fov_rays(omega: float, pixels: FloatArray, K: FloatArray) -> FloatArray:
    """Points ``(N, 2)`` of the plane z = 1 by Devernay and Faugeras's model, ``r_d = atan(2 r tan(w / 2)) / w``, for
    a ``K`` with `fov_magnification`."""
    seen = (pixels - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]]
    if omega == 0.0:
        return seen
    r = np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-12)
    angle = r * fov_magnification(omega) * omega
    if angle.max() >= 0.5 * np.pi:
        raise CalibrationError(
            f"its {FOV} lens of such a wide view is not supported, only plumb_bob; rectify the images"
        )
    return seen * np.tan(angle) / (2.0 * np.tan(0.5 * omega) * r)


def _pixels(size: tuple[int, int]) -> FloatArray:
    """Pixels ``(N, 1, 2)`` all over the image."""
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, _GRID), np.linspace(0, size[1] - 1, _GRID))
    return np.stack([u.ravel(), v.ravel()], axis=1)[:, None]


def _fitted(model: str, rays: FloatArray, pixels: FloatArray, K: FloatArray) -> tuple[tuple[float, ...], float]:
    """Brown-Conrady coefficients for points ``rays`` ``(N, 2)`` of the plane z = 1 that another model projects to
    ``pixels``, and the maximum error [px].

    The distorted position is linear in the five.

    Raises:
        CalibrationError: If the error exceeds `_MAX_MISFIT_PX`.
    """
    focal = np.array([K[0, 0], K[1, 1]])
    seen = (pixels - [K[0, 2], K[1, 2]]) / focal
    if not np.isfinite(rays).all() or np.abs(rays).max() > 1e3:
        raise CalibrationError(
            f"its {model} lens of such a wide view is not supported by plumb_bob; rectify the images"
        )
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
            f"its {model} lens is not supported, the best plumb_bob is up to {misfit_px:.1f} px off; rectify the images"
        )
    return tuple(float(k) for k in coefficients), misfit_px
