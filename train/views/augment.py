"""Geometric augmentation: image, depth and intrinsics change consistently."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

_LUMA = np.array([[0.114], [0.587], [0.299]], np.float32)
"""Grey from BGR (ITU-R BT.601)."""


@dataclass(frozen=True, slots=True)
class AugmentConfig:
    """Ranges; every draw is uniform unless said otherwise."""

    flip: float = 0.5
    """Probability of a horizontal flip."""
    zoom: tuple[float, float] = (0.85, 1.6)
    """Focal length of the virtual camera relative to the fitted one; above 1 crops, log-uniform."""
    aspect: float = 0.08
    """Largest relative difference of fx and fy (anisotropic resizing of other image shapes)."""
    roll_rad: float = 0.17
    tilt_rad: float = 0.12
    """Largest roll, and pitch or yaw, of the virtual camera."""
    shift: float = 0.12
    """Largest move of the principal point, in image widths, scaled by how much the zoom crops."""
    brightness: float = 0.25
    contrast: float = 0.3
    saturation: float = 0.5
    channel: float = 0.12
    """Largest relative gain of one colour channel (white balance)."""
    gamma: tuple[float, float] = (0.7, 1.4)
    grey: float = 0.1
    """Probability of a grey image."""
    blur: float = 0.3
    """Probability of a blur (half of them along a line, as motion)."""
    noise: float = 0.3
    """Probability of sensor noise."""


@dataclass(frozen=True, slots=True)
class View:
    """An image with its depth and camera, all of one size."""

    image: NDArray[np.uint8]
    """``(H, W, 3)`` BGR, undistorted."""
    depth_m: FloatArray
    """``(H, W)`` float32, 0 where unknown."""
    K: FloatArray
    """``(3, 3)`` intrinsics [px]."""

    @classmethod
    def without_depth(cls, image: NDArray[np.uint8], K: FloatArray) -> "View":
        """An image whose depth is not known anywhere."""
        return cls(image, np.zeros(image.shape[:2], np.float32), K)


def random_view(view: View, size: tuple[int, int], config: AugmentConfig, rng: np.random.Generator) -> View:
    """What a virtual camera of ``size = (height, width)`` at the same place sees: rotated, zoomed,
    mirrored, recoloured.

    Pure rotations and new intrinsics are homographies of the image, so this is exact; z-depth changes with
    the axis.
    """
    K, R = virtual_camera(view.K, view.depth_m.shape, size, config, rng)
    warped = warp(view, K, R, size)
    if rng.random() < config.flip:
        warped = mirrored(warped)
    return replace(warped, image=recolour(warped.image, config, rng))


def fitted_view(view: View, size: tuple[int, int]) -> View:
    """The whole image squeezed to ``size = (height, width)``, as at inference."""
    height, width = size
    h, w = view.image.shape[:2]
    image = cv2.resize(view.image, (width, height), interpolation=cv2.INTER_AREA)
    depth = cv2.resize(view.depth_m, (width, height), interpolation=cv2.INTER_NEAREST)
    K = scaled_K(view.K, width / w, height / h)
    return View(np.asarray(image, np.uint8), np.asarray(depth, np.float32), K)


def scaled_K(K: FloatArray, sx: float, sy: float) -> FloatArray:
    """Intrinsics of the image resized by ``sx, sy`` (pixel centres at integers)."""
    shift = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    return np.linalg.inv(shift) @ np.diag([sx, sy, 1.0]) @ shift @ K


def warp(view: View, K: FloatArray, R: FloatArray, size: tuple[int, int]) -> View:
    """The view through intrinsics ``K``, rotated by ``R`` (old camera to new camera coordinates)."""
    height, width = size
    H = K @ R @ np.linalg.inv(view.K)
    image = cv2.warpPerspective(
        view.image, H, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    depth = cv2.warpPerspective(
        view.depth_m,
        H,
        (width, height),
        flags=cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    old_z = rays @ R[:, 2]  # third row of R^T: z in the old camera of a ray with z = 1 in the new one
    depth_m = (depth / np.maximum(old_z, 0.1)).astype(np.float32)
    return View(np.asarray(image, np.uint8), depth_m, K)


def mirrored(view: View) -> View:
    """Left and right swapped."""
    K = view.K.copy()
    K[0, 2] = view.image.shape[1] - 1 - K[0, 2]
    return View(np.ascontiguousarray(view.image[:, ::-1]), np.ascontiguousarray(view.depth_m[:, ::-1]), K)


def virtual_camera(
    K: FloatArray, shape: tuple[int, ...], size: tuple[int, int], config: AugmentConfig, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Intrinsics ``(3, 3)`` [px] of a random camera of ``size = (height, width)``, and how it is turned against one of
    ``shape`` with intrinsics ``K`` (old camera to new camera coordinates)."""
    height, width = size
    h, w = shape
    zoom = np.exp(rng.uniform(*np.log(config.zoom)))
    stretch = np.exp(rng.uniform(-config.aspect, config.aspect) / 2)
    K = scaled_K(K, width / w * zoom * stretch, height / h * zoom / stretch)
    room = config.shift * width * max(zoom, 1.0)
    K[0, 2] += (1 - zoom * stretch) * width / 2 + rng.uniform(-room, room)
    K[1, 2] += (1 - zoom / stretch) * height / 2 + rng.uniform(-room, room)
    roll = rng.uniform(-config.roll_rad, config.roll_rad)
    pitch, yaw = rng.uniform(-config.tilt_rad, config.tilt_rad, 2)
    R, _ = cv2.Rodrigues(np.array([pitch, yaw, 0.0]))
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, roll]))
    return K, turn @ R


def recolour(image: NDArray[np.uint8], config: AugmentConfig, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Brightness, contrast, colour, gamma, blur and noise of another camera; ``(H, W, 3)`` BGR."""
    x = image.astype(np.float32) / 255.0
    if rng.random() < config.grey:
        x = np.repeat(x @ _LUMA, 3, axis=2)
    else:
        luma = x @ _LUMA
        x = luma + (x - luma) * rng.uniform(1 - config.saturation, 1 + config.saturation)
        x = x * rng.uniform(1 - config.channel, 1 + config.channel, 3).astype(np.float32)
    mean = x.mean()
    x = (x - mean) * rng.uniform(1 - config.contrast, 1 + config.contrast) + mean
    x = np.clip(x * rng.uniform(1 - config.brightness, 1 + config.brightness), 0, 1) ** rng.uniform(*config.gamma)
    if rng.random() < config.blur:
        x = _blur(x.astype(np.float32), rng)
    if rng.random() < config.noise:
        x = x + rng.normal(0, rng.uniform(0.005, 0.04), x.shape)
    return np.clip(x * 255.0 + 0.5, 0, 255).astype(np.uint8)


def _blur(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    if rng.random() < 0.5:
        return np.asarray(cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.5)), np.float32)
    length = int(rng.integers(3, 8))
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    c, d = (length - 1) / 2, (length - 1) / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(int(round(c + s * k)) for k in d) for s in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    return np.asarray(cv2.filter2D(x, -1, kernel / kernel.sum()), np.float32)
