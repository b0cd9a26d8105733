"""Faults of a cheap camera: light changes, noise, blur, vignetting."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.textures.image_ops import looked_up, product
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class CameraFaults:
    """Faults of the simulated camera; all zero leaves images unchanged.

    The defaults resemble a drone's camera indoors by day.
    """

    exposure_amplitude: float = 0.06
    """Slow brightness change, as a share (auto exposure)."""
    exposure_period_s: float = 7.0
    read_noise: float = 1.2
    """Standard deviation [grey levels]."""
    shot_noise: float = 0.12
    """Standard deviation per square root of a grey level."""
    vignetting: float = 0.15
    """Share of light lost in the image's corners."""
    shutter_s: float = 0.006
    """Exposure time, for motion blur."""
    gain: float = 1.0
    """Share of the light that reaches the sensor; the noise does not shrink with it."""

    def __post_init__(self) -> None:
        if min(self.read_noise, self.shot_noise, self.shutter_s, self.vignetting) < 0 or self.gain <= 0:
            raise ValueError(f"noise, shutter and vignetting must not be negative, the gain positive: {self}")


CLEAN = CameraFaults(exposure_amplitude=0.0, read_noise=0.0, shot_noise=0.0, vignetting=0.0, shutter_s=0.0)
"""A perfect camera."""


def with_brightness(image: np.ndarray, gain: float) -> np.ndarray:
    """``image * gain`` in grey levels, clipped to 8 bits."""
    levels = 255.0 * (np.arange(256) / 255.0) * gain
    return cv2.LUT(image, np.clip(levels + 0.5, 0, 255).astype(np.uint8))


def with_noise(rng: Rng, image: np.ndarray, read: float, shot: float) -> np.ndarray:
    """Gaussian noise of variance ``read^2 + shot^2 * level`` in grey levels, a little of it shared by the channels."""
    if read == 0 and shot == 0:
        return image
    # Noise is read from a random place of a long field: equivalent to new noise and far cheaper.
    table = _noise_table()
    if image.size >= len(table):
        noise = rng.standard_normal(image.shape, dtype=np.float32)
    else:
        start = int(rng.integers(0, len(table) - image.size))
        noise = table[start : start + image.size].reshape(image.shape)
    level = np.arange(256, dtype=np.float32)
    noisy = np.asarray(cv2.LUT(image, np.sqrt(read**2 + shot**2 * level).astype(np.float32)))
    np.multiply(noisy, noise, out=noisy)
    np.add(noisy, image, out=noisy)
    return cv2.convertScaleAbs(np.maximum(noisy, 0.0, out=noisy))


@lru_cache(maxsize=1)
def _noise_table() -> np.ndarray:
    """Standard normal numbers from a fixed seed."""
    return np.random.default_rng(20).standard_normal(1 << 22, dtype=np.float32)


def with_vignetting(image: np.ndarray, loss: float) -> np.ndarray:
    """Darkened towards the corners by ``loss`` there (quadratic in the radius)."""
    if loss == 0:
        return image
    channels = image.shape[2] if image.ndim == 3 else 1
    return product(image, _vignette(image.shape[0], image.shape[1], channels, loss))


@lru_cache(maxsize=8)
def _vignette(h: int, w: int, channels: int, loss: float) -> np.ndarray:
    """Gain in steps of 1/255, ``(h, w)`` or ``(h, w, channels)`` float32."""
    x, y = (np.arange(w) - (w - 1) / 2) / (w / 2), (np.arange(h) - (h - 1) / 2) / (h / 2)
    gain = np.rint(255.0 * (1.0 - 0.5 * loss * (x[None] ** 2 + y[:, None] ** 2)))
    return cv2.merge([(np.clip(gain, 0, 255) / 255.0).astype(np.float32)] * channels)


def with_motion_blur(
    image: np.ndarray, depth_m: FloatArray, camera: Camera, twist_c: FloatArray, shutter_s: float
) -> np.ndarray:
    """Mean of three images, or five when it moves far, warped along the optical flow while the shutter is open.

    ``twist_c`` ``(6,)`` is the velocity [m/s] and rotation rate [rad/s] of the camera in its own axes.
    """
    v, omega = np.asarray(twist_c[:3], dtype=np.float64), np.asarray(twist_c[3:], dtype=np.float64)
    if shutter_s == 0 or not np.any(twist_c):
        return image
    # The flow is smooth but for depth steps; a quarter of the pixels carry it.
    h, w = depth_m.shape
    z = cv2.resize(depth_m, (w // 4, h // 4), interpolation=cv2.INTER_NEAREST).astype(np.float64)
    small = camera.scaled(w // 4, h // 4)
    x = (np.arange(w // 4)[None] - small.cx) / small.fx
    y = (np.arange(h // 4)[:, None] - small.cy) / small.fy
    iz = np.where(z > 0.05, 1.0 / np.maximum(z, 0.05), 0.0)
    # Image motion of a still point (Longuet-Higgins and Prazdny 1980), pixels per second.
    du = camera.fx * ((x * v[2] - v[0]) * iz + x * y * omega[0] - (1 + x * x) * omega[1] + y * omega[2])
    dv = camera.fy * ((y * v[2] - v[1]) * iz + (1 + y * y) * omega[0] - x * y * omega[1] - x * omega[2])
    # In steps of 1/1024 px, four times the size has no rounding: the same on every processor.
    flow = (np.rint(np.stack([du, dv], axis=-1) * (1024.0 * shutter_s)) / 1024.0).astype(np.float32)
    longest = float(np.percentile(np.linalg.norm(flow, axis=-1), 98))
    if longest < 0.4:
        return image
    flow = np.asarray(cv2.resize(flow, (w, h), interpolation=cv2.INTER_LINEAR))
    flow_x, flow_y = np.ascontiguousarray(flow[..., 0]), np.ascontiguousarray(flow[..., 1])
    x, y = _pixel_grid(h, w)
    steps = 3 if longest < 3.0 else 5
    total = image.astype(np.float32)
    for k in range(steps):
        share = k / (steps - 1) - 0.5
        if share == 0:
            continue
        map_x, map_y = x - np.float32(share) * flow_x, y - np.float32(share) * flow_y
        cv2.accumulate(looked_up(image, map_x, map_y), total)
    return cv2.convertScaleAbs(total, alpha=1.0 / steps)


@lru_cache(maxsize=4)
def _pixel_grid(h: int, w: int) -> np.ndarray:
    """Pixel coordinates x and y, ``(2, h, w)`` float32."""
    return np.stack(np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32)))


def degraded(
    rng: Rng,
    image: np.ndarray,
    depth_m: FloatArray,
    camera: Camera,
    faults: CameraFaults,
    *,
    stamp_s: float = 0.0,
    twist_c: FloatArray | None = None,
) -> np.ndarray:
    """Image as the simulated camera delivers it at time ``stamp_s`` while it moves with ``twist_c``."""
    if twist_c is not None:
        image = with_motion_blur(image, depth_m, camera, twist_c, faults.shutter_s)
    gain = faults.gain * (1.0 + faults.exposure_amplitude * np.sin(2 * np.pi * stamp_s / faults.exposure_period_s))
    if gain != 1.0:
        image = with_brightness(image, float(gain))
    image = with_vignetting(image, faults.vignetting)
    return with_noise(rng, image, faults.read_noise, faults.shot_noise)
