"""Noise and colours that all procedural textures share."""

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray

Rng = np.random.Generator


def fractal(rng: Rng, shape: tuple[int, int], beta: float = 1.0, stretch: float = 1.0) -> FloatArray:
    """Tileable 1/f**beta noise, zero mean and unit deviation, float32; ``stretch`` > 1 draws it out along x."""
    h, w = shape
    fy, fx = np.fft.fftfreq(h)[:, None] * h, np.fft.rfftfreq(w)[None] * w
    f = np.sqrt((fx * stretch) ** 2 + fy**2)
    f[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32)) * f**-beta
    noise = np.fft.irfft2(spectrum, s=shape).astype(np.float32)
    return noise / max(float(noise.std()), 1e-6)


def colour(
    rng: Rng, saturation: tuple[float, float] = (0.0, 0.5), value: tuple[float, float] = (0.3, 0.9)
) -> FloatArray:
    """Random colour, BGR in 0..255; hues as indoors: mostly warm, then blue, then anything."""
    kind = rng.random()
    hue = rng.normal(32, 14) if kind < 0.6 else rng.normal(212, 18) if kind < 0.8 else rng.uniform(0, 360)
    hsv = np.array([[[hue % 360, rng.uniform(*saturation), rng.uniform(*value)]]], np.float32)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0] * 255.0)


def timber(rng: Rng) -> FloatArray:
    """Colour of wood: red over green over blue, pale to dark."""
    red = rng.uniform(110, 215)
    green = red * rng.uniform(0.68, 0.85)
    return np.array([green * rng.uniform(0.45, 0.85), green, red]) * rng.uniform(0.55, 1.05)


def shaded(base: FloatArray, field: FloatArray) -> np.ndarray:
    """Colour(s) times a brightness field ``(H, W)``."""
    return np.clip(base * field[..., None], 0, 255).astype(np.uint8)
