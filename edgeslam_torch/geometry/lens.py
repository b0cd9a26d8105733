"""Plausibility of a calibration: mistyped numbers, wrong units, or a fit to too few images."""

import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

FOCAL = (0.1, 20.0)
"""Plausible focal lengths relative to the image's longer side: 168 and 3 degrees of view."""
_ASPECT = 3.0
"""Maximum ratio of the two focal lengths."""
_MARGIN = 0.5
"""Maximum distance of the principal point outside the image, relative to its width or height."""
_MAX_PULLED = 0.5
"""Minimum ratio of undistorted to distorted distance from the principal point, at the border."""
_FARTHEST = 10.0
"""Maximum ratio of undistorted to distorted distance, at the border."""
UNIQUE = 2 / 3
"""Share of the distance to the border within which the distortion must be invertible. Not 1, because real lenses
modelled with k1 alone (such as -0.3) fold at 0.7 of the distance to the corners."""


def check_camera(camera: Camera) -> None:
    """Reject implausible calibrations.

    Raises:
        CalibrationError: If focal length, principal point or distortion are impossible.
    """
    longest = max(camera.width, camera.height)
    low, high = sorted((camera.fx, camera.fy))
    inside = all(
        -_MARGIN * side <= c <= (1.0 + _MARGIN) * side
        for c, side in ((camera.cx, camera.width), (camera.cy, camera.height))
    )
    if not (inside and FOCAL[0] * longest <= low and high <= min(FOCAL[1] * longest, _ASPECT * low)):
        raise CalibrationError(
            f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} cannot be pixels of a "
            f"{camera.width}x{camera.height} image"
        )
    if unique_share(camera) < UNIQUE:
        numbers = ", ".join(f"{k:g}" for k in camera.distortion)
        raise CalibrationError(
            f"distortion [{numbers}] cannot be a lens's: the distorted image folds over or has a gap"
        )


def unique_share(camera: Camera) -> float:
    """Share of the distance from the principal point to the border within which the distortion is invertible.

    1 if everywhere. Where the model folds, two pixels share a ray; beyond, rays have no pixel.
    """
    if not camera.is_distorted:
        return 1.0
    t = np.linspace(0.0, _FARTHEST, 1001)[1:]
    with np.errstate(all="ignore"):
        xy, det = _distorted(camera, _border(camera)[:, :, None] * t)  # (2, R, T), (R, T)
        progress = _progress(camera, xy)
        good = np.logical_and.accumulate((det > 0.0) & np.isfinite(progress), axis=1)
        torn = bool(np.any(progress[:, t <= _MAX_PULLED] > 1.0))
    farthest = np.max(np.where(good, progress, 0.0), axis=1)
    return 0.0 if torn else float(min(1.0, farthest.min()))


def _sides(camera: Camera) -> tuple[float, float, float, float]:
    """Left, right, upper and lower border relative to the principal point [px], at least one pixel."""
    right, down = max(camera.width - 0.5 - camera.cx, 1.0), max(camera.height - 0.5 - camera.cy, 1.0)
    return min(-0.5 - camera.cx, -1.0), right, min(-0.5 - camera.cy, -1.0), down


def _border(camera: Camera) -> FloatArray:
    """Points ``(2, R)`` of the plane z = 1 that project to the image border without distortion, including the
    corners."""
    left, right, up, down = _sides(camera)
    u, v = np.linspace(left, right, 25), np.linspace(up, down, 25)
    across = [np.stack([u, np.full_like(u, side)]) for side in (up, down)]
    along = [np.stack([np.full_like(v, side), v]) for side in (left, right)]
    return np.concatenate([*across, *along], axis=1) / [[camera.fx], [camera.fy]]


def _progress(camera: Camera, xy: FloatArray) -> FloatArray:
    """Position of points ``(2, ...)`` of the plane z = 1 between the principal point (0) and the border (1)."""
    left, right, up, down = _sides(camera)
    u, v = camera.fx * xy[0], camera.fy * xy[1]
    return np.maximum(np.where(u > 0, u / right, u / left), np.where(v > 0, v / down, v / up))


def _distorted(camera: Camera, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted points ``(2, ...)`` of the plane z = 1, and the determinant of the distortion's Jacobian."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = xy
    s = x * x + y * y
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))  # d radial / d s, times 2
    x_out = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    y_out = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    dx_dx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    dy_dy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    cross = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return np.stack([x_out, y_out]), dx_dx * dy_dy - cross * cross
