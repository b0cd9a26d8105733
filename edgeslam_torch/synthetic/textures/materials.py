"""Procedural materials: seeded, photo-like tiles ``(TILE_PX, TILE_PX, 3)`` uint8 BGR that repeat without a seam."""

from collections.abc import Callable

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
TILE_M = 1.6
"""Side of a tile [m]."""
TILE_PX = 448
"""Side of a tile [px]: 3.6 mm a texel."""


def plaster(rng: Rng) -> np.ndarray:
    """Painted wall, weak texture."""
    base = colour(rng, (0.0, 0.25), (0.6, 0.95))
    strength = rng.uniform(0.008, 0.03)
    field = 1 + strength * fractal(rng, 0.8) + strength * fractal(rng, 0.2)
    return shaded(base, field)


def rough_plaster(rng: Rng) -> np.ndarray:
    """Render with visible grain, lit from one side."""
    base = colour(rng, (0.0, 0.3), (0.5, 0.9))
    height = fractal(rng, rng.uniform(0.6, 1.2))
    slope = height - np.roll(height, (1, 1), (0, 1))
    return shaded(base, 1 + rng.uniform(0.04, 0.12) * slope + 0.03 * height)


def concrete(rng: Rng) -> np.ndarray:
    """Stained concrete with pores."""
    base = colour(rng, (0.0, 0.1), (0.4, 0.7))
    field = 1 + 0.09 * fractal(rng, 1.4) + 0.04 * fractal(rng, 0.3)
    image = shaded(base, field)
    for _ in range(60):
        centre = rng.integers(0, TILE_PX, 2).tolist()
        cv2.circle(image, centre, int(rng.integers(1, 3)), (base * rng.uniform(0.4, 0.7)).tolist(), -1, cv2.LINE_AA)
    return image


def wallpaper(rng: Rng) -> np.ndarray:
    """A mirrored motif repeated in a half-drop grid, or stripes."""
    size = int(rng.choice([56, 112, 224]))
    half = fractal(rng, rng.uniform(1.2, 1.8), (size, size // 2))
    motif = np.hstack([half, half[:, ::-1]])
    mask = cv2.GaussianBlur((motif > rng.uniform(0.2, 0.8)).astype(np.float32), (0, 0), 0.8)
    tile = np.tile(mask, (TILE_PX // size, TILE_PX // size))
    if rng.random() < 0.3:
        period = int(rng.choice([28, 56, 112]))
        tile = np.tile((np.arange(TILE_PX) % period < period * rng.uniform(0.2, 0.6)).astype(np.float32), (TILE_PX, 1))
    a = colour(rng, (0.05, 0.45), (0.5, 0.9))
    b = np.clip(a * rng.uniform(0.6, 1.25) + rng.normal(0, 12, 3), 0, 255)
    image = a + (b - a) * tile[..., None]
    return shaded(image, 1 + 0.02 * fractal(rng, 0.4))


def wood(rng: Rng) -> np.ndarray:
    """Planks along x with grain, knots' waves and gaps."""
    tone = timber(rng)
    planks = int(rng.choice([4, 7, 8, 14]))
    width = TILE_PX // planks
    grain = fractal(rng, 1.0, stretch=14.0)
    wave = fractal(rng, 1.8, stretch=5.0)
    rings = np.sin(6.28 * (rng.uniform(1.5, 4.0) * wave + 0.3 * grain))
    field = 1 + 0.06 * grain + 0.07 * rings + 0.02 * fractal(rng, 0.1)
    for i in range(planks):
        rows = slice(i * width, (i + 1) * width)
        field[rows] = np.roll(field[rows], int(rng.integers(0, TILE_PX)), axis=1) * rng.uniform(0.85, 1.12)
        field[i * width] *= 0.55
        joint = int(rng.integers(0, TILE_PX))
        field[rows, joint] *= 0.6
    return shaded(tone, field)


def veneer(rng: Rng) -> np.ndarray:
    """Continuous wood surface of furniture."""
    tone = timber(rng)
    grain = fractal(rng, 1.0, stretch=20.0)
    wave = fractal(rng, 1.9, stretch=6.0)
    field = 1 + 0.07 * grain + 0.06 * np.sin(6.28 * (rng.uniform(1, 3) * wave + 0.2 * grain))
    return shaded(tone, field)


def bricks(rng: Rng) -> np.ndarray:
    """Running bond with mortar."""
    rows, columns = 16, 8
    h, w = TILE_PX // rows, TILE_PX // columns
    plain = rng.random() < 0.3
    tone = colour(rng, (0.3, 0.6), (0.4, 0.7)) if plain else np.array([60.0, 75.0, 150.0]) * rng.uniform(0.6, 1.2)
    mortar = colour(rng, (0.0, 0.1), (0.5, 0.8))
    image = np.empty((TILE_PX, TILE_PX, 3), np.float32)
    for r in range(rows):
        band = np.tile(mortar.astype(np.float32), (h, TILE_PX, 1))
        for c in range(columns):
            band[2:, c * w + 2 : (c + 1) * w] = tone * rng.uniform(0.75, 1.2) + rng.normal(0, 6, 3)
        image[r * h : (r + 1) * h] = np.roll(band, (r % 2) * w // 2, axis=1)
    field = 1 + 0.08 * fractal(rng, 0.6) + 0.04 * fractal(rng, 0.1)
    return shaded(np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6)), field)


def tiles(rng: Rng) -> np.ndarray:
    """Square tiles with grout, plain, chequered or marbled."""
    n = int(rng.choice([4, 8, 14]))
    side = TILE_PX // n
    a = colour(rng, (0.0, 0.35), (0.45, 0.95))
    b = a * rng.uniform(0.45, 0.8) if rng.random() < 0.4 else a
    image = np.empty((TILE_PX, TILE_PX, 3), np.float32)
    marble = fractal(rng, 1.5)
    veins = np.exp(-((marble / 0.08) ** 2)) * rng.uniform(0.0, 0.25)
    for r in range(n):
        for c in range(n):
            tone = a if (r + c) % 2 == 0 else b
            image[r * side : (r + 1) * side, c * side : (c + 1) * side] = tone * rng.uniform(0.94, 1.06)
    image *= (1 + 0.03 * marble - veins)[..., None]
    grout = colour(rng, (0.0, 0.1), (0.25, 0.8))
    for k in range(n):
        image[k * side : k * side + 2] = grout
        image[:, k * side : k * side + 2] = grout
    return shaded(image, 1 + 0.02 * fractal(rng, 0.2))


def carpet(rng: Rng) -> np.ndarray:
    """Short pile: strong fine noise, sometimes in squares."""
    base = colour(rng, (0.0, 0.5), (0.2, 0.65))
    field = 1 + rng.uniform(0.1, 0.25) * cv2.GaussianBlur(fractal(rng, 0.1), (0, 0), 0.7)
    field += 0.06 * fractal(rng, 1.0)
    if rng.random() < 0.4:
        n = int(rng.choice([4, 8]))
        field *= np.kron(rng.uniform(0.85, 1.1, (n, n)), np.ones((TILE_PX // n, TILE_PX // n)))
    return shaded(base, field.astype(np.float32))


def fabric(rng: Rng) -> np.ndarray:
    """Woven cloth, plain, striped or tartan."""
    y, x = np.mgrid[0:TILE_PX, 0:TILE_PX]
    period = float(rng.choice([4, 7, 8]))
    field = 1 + 0.08 * np.sin(6.2832 * x / period) * np.sin(6.2832 * y / period)
    field = field + 0.05 * fractal(rng, 0.5)
    image = np.empty((TILE_PX, TILE_PX, 3), np.float32)
    image[:] = colour(rng, (0.1, 0.7), (0.25, 0.8))
    kind = rng.random()
    if kind < 0.6:
        for _ in range(int(rng.integers(2, 6))):
            repeat = TILE_PX // int(rng.choice([2, 4, 7]))
            start, width = int(rng.integers(0, repeat)), int(rng.integers(2, max(3, repeat // 3)))
            tint, opacity = colour(rng, (0.1, 0.7), (0.2, 0.9)), rng.uniform(0.3, 0.7)
            columns = (np.arange(TILE_PX) - start) % repeat < width
            image[:, columns] += opacity * (tint - image[:, columns])
            if kind < 0.35:
                image[columns] += opacity * (tint - image[columns])
    return shaded(image, field.astype(np.float32))


def metal(rng: Rng) -> np.ndarray:
    """Brushed or painted metal."""
    base = colour(rng, (0.0, 0.2), (0.35, 0.85))
    field = 1 + rng.uniform(0.01, 0.05) * fractal(rng, 0.4, stretch=30.0)
    return shaded(base, field + 0.02 * fractal(rng, 1.3))


def terrazzo(rng: Rng) -> np.ndarray:
    """Chips in cement."""
    image = shaded(colour(rng, (0.0, 0.15), (0.5, 0.85)), 1 + 0.03 * fractal(rng, 0.5))
    for _ in range(int(rng.integers(500, 1600))):
        points = rng.integers(6, TILE_PX - 6, 2) + rng.normal(0, rng.uniform(1.0, 4.0), (5, 2))
        chip = cv2.convexHull(points.astype(np.float32)).astype(np.int32)
        cv2.fillConvexPoly(image, chip, colour(rng, (0, 0.4), (0.2, 0.95)).tolist())
    return image


def dead_leaves(rng: Rng, shape: tuple[int, int] = (TILE_PX, TILE_PX), count: int = 700) -> np.ndarray:
    """Overlapping blobs with a power law of sizes: the statistics of natural images (Ruderman 1997)."""
    h, w = shape
    image = np.empty((h, w, 3), np.uint8)
    image[:] = colour(rng).astype(np.uint8)
    radii = np.sort(np.clip(3.0 * (1 - rng.random(count)) ** -0.6, 0, min(h, w) / 3.5))[::-1]
    palette = [colour(rng, (0.0, 0.8), (0.1, 1.0)) for _ in range(int(rng.integers(4, 12)))]
    for radius in radii:
        tone = palette[int(rng.integers(len(palette)))] * rng.uniform(0.6, 1.2)
        centre = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        if rng.random() < 0.5:
            axes = (int(radius) + 1, int(radius * rng.uniform(0.4, 1)) + 1)
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, tone.tolist(), -1, cv2.LINE_AA)
        else:
            half = np.array([radius, radius * rng.uniform(0.25, 1)])
            box = _turned_box(centre, half, np.deg2rad(rng.uniform(0, 90)))
            cv2.fillConvexPoly(image, box, tone.tolist(), cv2.LINE_AA)
    return shaded(image.astype(np.float32), 1 + 0.05 * fractal(rng, 1.0, shape))


def _turned_box(centre: tuple[int, int], half: FloatArray, turn_rad: float) -> np.ndarray:
    """Corners ``(4, 2)`` int32 of a rectangle; not by `cv2.boxPoints`, whose floats depend on the processor."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    corners = half * np.array([[-1, 1], [-1, -1], [1, -1], [1, 1]])
    return (centre + corners @ np.array([[c, s], [-s, c]])).astype(np.int32)


def ceiling_panels(rng: Rng) -> np.ndarray:
    """Suspended ceiling: perforated or flecked panels in a grid, tileable."""
    base = colour(rng, (0.0, 0.06), (0.75, 0.95))
    image = shaded(base, 1 + 0.02 * fractal(rng, 0.3)).astype(np.float32)
    flecks = rng.random((TILE_PX, TILE_PX)) < 0.01
    image[flecks] *= 0.7
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6))
    n = int(rng.choice([2, 4]))
    for k in range(n):
        at = k * TILE_PX // n
        image[at : at + 3] = base * 1.1
        image[:, at : at + 3] = base * 1.1
        image[at + 3] *= 0.6
        image[:, at + 3] *= 0.6
    return np.clip(image, 0, 255).astype(np.uint8)


MATERIALS: dict[str, Callable[[Rng], np.ndarray]] = {
    draw.__name__: draw
    for draw in (
        plaster, rough_plaster, concrete, wallpaper, wood, veneer, bricks, tiles, carpet, fabric, metal, terrazzo,
        dead_leaves, ceiling_panels,
    )
}  # fmt: skip


def fractal(rng: Rng, beta: float, shape: tuple[int, int] = (TILE_PX, TILE_PX), stretch: float = 1.0) -> FloatArray:
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
