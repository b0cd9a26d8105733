"""Procedural pictures, drawn once for one surface: posters, books, screens, doors, windows; ``(H, W, 3)`` uint8 BGR."""

import cv2
import numpy as np

from edgeslam_torch.synthetic.textures.materials import TILE_PX, Rng, colour, dead_leaves, fractal, shaded, veneer
from edgeslam_torch.types import FloatArray

WORDS = (
    "EXIT", "LIMIT", "ROOM", "PLAN", "SAFETY", "NOTICE", "EDGE", "LIGHT", "NORTH", "MOTION", "FIELD", "PAPER",
    "STUDY", "WORLD", "SIGNAL", "MAP", "TODAY", "CITY", "SUMMER", "GARDEN", "SCIENCE", "MUSIC", "ATLAS",
    "HISTORY", "OPEN", "DESIGN", "ENERGY", "NUMBER", "THEORY", "WINTER", "VECTOR", "RIVER",
)  # fmt: skip
FONTS = tuple(
    getattr(cv2, f"FONT_HERSHEY_{name}") for name in ("SIMPLEX", "DUPLEX", "COMPLEX", "TRIPLEX", "SCRIPT_SIMPLEX")
)


def landscape(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Sky, hills and trees: what a window or a photograph shows."""
    h, w = shape
    top = np.array([rng.uniform(190, 250), rng.uniform(150, 200), rng.uniform(90, 170)])
    bottom = colour(rng, (0.0, 0.2), (0.9, 1.0))
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    image = np.broadcast_to(top + (bottom - top) * ramp, (h, w, 3)).copy()
    clouds = np.clip(fractal(rng, 1.6, shape, stretch=2.0) * 0.3, 0, 0.6)[..., None]
    image += (255 - image) * clouds
    rows = np.arange(h)[:, None]
    level = rng.uniform(0.3, 0.55)
    for _ in range(int(rng.integers(2, 5))):
        line = h * (level + 0.06 * np.cumsum(rng.normal(0, 1, w)) / np.sqrt(w))
        tone = colour(rng, (0.2, 0.6), (0.15, 0.6)) * np.array([0.7, 1.1, 0.8])
        ground = rows > line[None]
        image[ground] = (tone * (1 + 0.25 * fractal(rng, 0.8, shape))[..., None])[ground]
        level += rng.uniform(0.08, 0.2)
    return np.clip(image, 0, 255).astype(np.uint8)


def _text_block(rng: Rng, image: np.ndarray, x: int, y: int, w: int, lines: int, size: float, ink: list[float]) -> int:
    """Lines of words; returns the y below them."""
    font, step = int(rng.choice(FONTS)), max(5, int(30 * size))
    for _ in range(lines):
        words = " ".join(str(s) for s in rng.choice(WORDS, 8))
        if rng.random() < 0.7:
            words = words.lower()
        letters = max(2, int(w * rng.uniform(0.6, 1.0) / (19 * size)))
        y += step
        cv2.putText(image, words[:letters], (x, y), font, size, ink, max(1, round(1.6 * size)), cv2.LINE_AA)
    return y + step // 2


def poster(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Printed poster, picture or notice, with a border."""
    h, w = shape
    paper = colour(rng, (0.0, 0.6), (0.55, 1.0))
    image = np.tile(paper.astype(np.uint8), (h, w, 1))
    ink = (colour(rng, (0.0, 0.9), (0.0, 0.35)) if paper.mean() > 120 else np.full(3, 235.0)).tolist()
    kind = rng.random()
    m = max(4, min(h, w) // 16)
    if kind < 0.35:
        image[m : h - m, m : w - m] = landscape(rng, (h - 2 * m, w - 2 * m))
    elif kind < 0.55:
        image[m : h - m, m : w - m] = dead_leaves(rng, (h - 2 * m, w - 2 * m), 250)
    elif kind < 0.75:
        for _ in range(int(rng.integers(5, 14))):
            tone = colour(rng, (0.2, 0.9), (0.1, 1.0)).tolist()
            a, b = (rng.integers(m, [w - m, h - m]).tolist() for _ in range(2))
            shape_kind = rng.random()
            if shape_kind < 0.35:
                cv2.rectangle(image, a, b, tone, -1)
            elif shape_kind < 0.7:
                cv2.circle(image, a, int(rng.uniform(0.04, 0.22) * min(h, w)), tone, -1, cv2.LINE_AA)
            else:
                cv2.line(image, a, b, tone, int(rng.integers(2, 8)), cv2.LINE_AA)
        _text_block(rng, image, m, h - 5 * m, w - 2 * m, 1, min(h, w) / 220, ink)
    else:
        y = _text_block(rng, image, m, 0, w - 2 * m, 1, min(h, w) / 180, ink)
        split = int(h * rng.uniform(0.35, 0.6))
        if split > y + 20:
            image[y:split, m : w - m] = landscape(rng, (split - y, w - 2 * m))
        size = min(h, w) / 600
        lines = max(1, int((h - max(split, y) - m) / max(5, int(30 * size))) - 1)
        _text_block(rng, image, m, max(split, y), w - 2 * m, lines, size, ink)
    frame = (colour(rng, (0.0, 0.5), (0.05, 0.6)) * (rng.random() < 0.6)).tolist()
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), frame, max(2, m // 2))
    return image


def book_spines(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """A row of books on a board, with dark gaps above."""
    h, w = shape
    image = np.full((h, w, 3), 26, np.uint8)
    x = 0
    while x < w - 3:
        width = int(rng.uniform(0.06, 0.16) * h) + 3
        if rng.random() < 0.07:
            x += int(rng.uniform(0.1, 0.5) * h)
            continue
        top = int(h * rng.uniform(0.05, 0.35))
        right = min(w, x + width)
        tone = colour(rng, (0.0, 0.85), (0.15, 0.95))
        profile = 1 - 0.35 * np.abs(np.linspace(-1, 1, right - x)) ** 3
        image[top:, x:right] = np.clip(tone * profile[None, :, None], 0, 255)
        ink = (np.full(3, 230.0) if tone.mean() < 130 else np.full(3, 30.0)).tolist()
        for _ in range(int(rng.integers(0, 4))):
            y = int(rng.uniform(top + 2, h - 4))
            image[y : y + int(rng.integers(1, 5)), x:right] = np.array(ink, np.uint8)
        if width > 9:
            label = np.zeros((right - x, h - top, 3), np.uint8)
            scale = width / 40
            cv2.putText(label, " ".join(rng.choice(WORDS, 3)), (6, int(width * 0.68)), FONTS[1], scale, (255,) * 3, 1)
            letters = cv2.rotate(label, cv2.ROTATE_90_CLOCKWISE)[..., :1] > 90
            image[top:, x:right] = np.where(letters, np.array(ink, np.uint8), image[top:, x:right])
        image[top:, right - 1 : right] //= 2
        x = right
    return image


def screen(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Computer display with windows, or dark."""
    h, w = shape
    if rng.random() < 0.25:
        return np.full((h, w, 3), 22, np.uint8)
    image = landscape(rng, shape) if rng.random() < 0.5 else np.full((h, w, 3), 60, np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        x, y = int(rng.uniform(0, 0.4) * w), int(rng.uniform(0, 0.3) * h)
        right, bottom = int(rng.uniform(x + 0.4 * w, w)), int(rng.uniform(y + 0.4 * h, h))
        dark = rng.random() < 0.5
        image[y:bottom, x:right] = 35 if dark else 240
        cv2.rectangle(image, (x, y), (right, y + h // 20), (150, 110, 70), -1)
        ink = [200.0] * 3 if dark else [60.0] * 3
        size = h / 900
        lines = max(1, int((bottom - y) / max(5, int(30 * size))) - 2)
        _text_block(rng, image[y:bottom, x:right], 5, h // 20, right - x - 10, lines, size, ink)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (15, 15, 15), max(2, h // 28))
    return image


def _panel(image: np.ndarray, x: int, y: int, w: int, h: int, raised: bool) -> None:
    """Bevelled rectangle."""
    light, dark = (1.12, 0.72) if raised else (0.72, 1.12)
    for k in range(3):
        for part, factor in (
            (np.s_[y + k, x + k : x + w - k], light),
            (np.s_[y + h - 1 - k, x + k : x + w - k], dark),
            (np.s_[y + k : y + h - k, x + k], light),
            (np.s_[y + k : y + h - k, x + w - 1 - k], dark),
        ):
            image[part] = np.clip(image[part] * factor, 0, 255).astype(image.dtype)


def _finish(rng: Rng, shape: tuple[int, int]) -> FloatArray:
    """Painted or veneered surface, float."""
    h, w = shape
    if rng.random() < 0.5:
        tile = veneer(rng)
        if h > w:
            tile = cv2.rotate(tile, cv2.ROTATE_90_CLOCKWISE)
        return np.tile(tile, (h // TILE_PX + 1, w // TILE_PX + 1, 1))[:h, :w].astype(np.float32)
    base = colour(rng, (0.0, 0.5), (0.35, 0.95))
    return base * (1 + 0.015 * fractal(rng, 0.6, shape))[..., None]


def door(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Door leaf with panels, perhaps a window and a number plate, and a handle."""
    h, w = shape
    image = _finish(rng, shape)
    m = w // 8
    kind = rng.random()
    if kind < 0.6:
        rows = int(rng.integers(1, 4))
        height = (h - m * (rows + 1)) // rows
        for r in range(rows):
            for c in range(2 if rng.random() < 0.5 else 1):
                columns = 2 if c or rows > 2 else 1
                width = (w - m * (columns + 1)) // columns
                for k in range(columns):
                    _panel(image, m + k * (width + m), m + r * (height + m), width, height, True)
    elif kind < 0.8:
        pane = image[2 * m : h // 3, w - 3 * m : w - m]
        pane[:] = landscape(rng, pane.shape[:2]) * 0.4 + 40
        _panel(image, w - 3 * m, 2 * m, 2 * m, h // 3 - 2 * m, False)
    image = np.clip(image, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        cv2.rectangle(image, (w // 3, h // 6), (w // 3 + w // 4, h // 6 + w // 10), (235, 235, 235), -1)
        number, at = f"{rng.integers(100, 400)}", (w // 3 + 3, h // 6 + w // 12)
        cv2.putText(image, number, at, FONTS[1], w / 420, (40, 40, 40), 1, cv2.LINE_AA)
    x, y = int(0.9 * w), int(0.53 * h)
    cv2.rectangle(image, (x - w // 40, y - h // 30), (x + w // 40, y + h // 20), (150, 155, 160), -1, cv2.LINE_AA)
    cv2.line(image, (x, y), (x - w // 8, y), (195, 200, 205), max(3, h // 110), cv2.LINE_AA)
    cv2.line(image, (x, y + h // 200 + 2), (x - w // 8, y + h // 200 + 2), (80, 85, 90), 1, cv2.LINE_AA)
    return image


def cabinet(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Front with drawers and doors, gaps and handles."""
    h, w = shape
    image = _finish(rng, shape)
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    ys = np.linspace(0, h, rows + 1).astype(int)
    xs = np.linspace(0, w, columns + 1).astype(int)
    image = np.clip(image, 0, 255).astype(np.uint8)
    round_knob = rng.random() < 0.5
    metal_tone = colour(rng, (0.0, 0.15), (0.3, 0.9)).tolist()
    for y0, y1 in zip(ys[:-1], ys[1:], strict=True):
        for x0, x1 in zip(xs[:-1], xs[1:], strict=True):
            cv2.rectangle(image, (int(x0), int(y0)), (int(x1) - 1, int(y1) - 1), (25, 25, 28), 2)
            _panel(image, x0 + 2, y0 + 2, x1 - x0 - 4, y1 - y0 - 4, True)
            cx, cy = int(x0 + x1) // 2, int(y0 + 0.3 * (y1 - y0))
            if round_knob:
                cv2.circle(image, (cx, cy), max(3, h // 60), metal_tone, -1, cv2.LINE_AA)
            else:
                reach = max(6, int(x1 - x0) // 8)
                cv2.line(image, (cx - reach, cy + 2), (cx + reach, cy + 2), (40, 40, 40), 3, cv2.LINE_AA)
                cv2.line(image, (cx - reach, cy), (cx + reach, cy), metal_tone, 3, cv2.LINE_AA)
    return image


def window(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Bright view behind panes."""
    h, w = shape
    image = np.clip(landscape(rng, shape).astype(np.float32) * rng.uniform(0.8, 1.5) + 30, 0, 255).astype(np.uint8)
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    bar = colour(rng, (0.0, 0.15), (0.6, 0.95)).tolist()
    thick = max(4, min(h, w) // 24)
    for x in np.linspace(0, w - 1, columns + 1).astype(int):
        cv2.line(image, (int(x), 0), (int(x), h), bar, thick)
    for y in np.linspace(0, h - 1, rows + 1).astype(int):
        cv2.line(image, (0, int(y)), (w, int(y)), bar, thick)
    if rng.random() < 0.35:  # Venetian blind
        for y in range(0, int(h * rng.uniform(0.3, 1.0)), max(6, h // 40)):
            cv2.line(image, (0, y), (w, y), (215, 220, 222), max(2, h // 90))
    return image


def whiteboard(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Scribbles on white, or papers pinned on cork."""
    h, w = shape
    if rng.random() < 0.5:
        inks = [[160.0, 60.0, 30.0], [40.0, 40.0, 190.0], [40.0, 40.0, 40.0], [60.0, 130.0, 30.0]]
        image = shaded(np.array([235.0, 238.0, 236.0]), 1 + 0.01 * fractal(rng, 1.5, shape))
        for _ in range(int(rng.integers(3, 8))):
            ink = inks[int(rng.integers(4))]
            x, y = int(rng.uniform(0.03, 0.6) * w), int(rng.uniform(0.0, 0.7) * h)
            if rng.random() < 0.6:
                _text_block(rng, image, x, y, int(0.35 * w), int(rng.integers(1, 5)), h / 500, ink)
            else:
                points = np.cumsum(rng.normal(0, 0.05 * h, (12, 2)), axis=0) + [x + 0.1 * w, y + 0.1 * h]
                cv2.polylines(image, [points.astype(np.int32)], bool(rng.random() < 0.3), ink, 2, cv2.LINE_AA)
    else:
        image = shaded(np.array([90.0, 140.0, 185.0]), 1 + 0.12 * fractal(rng, 0.4, shape))
        for _ in range(int(rng.integers(5, 14))):
            ph, pw = int(rng.uniform(0.15, 0.4) * h), int(rng.uniform(0.08, 0.2) * w)
            x, y = int(rng.uniform(0, max(1, w - pw))), int(rng.uniform(0, max(1, h - ph)))
            image[y : y + ph, x : x + pw] = poster(rng, (ph, pw))[: h - y, : w - x]
            cv2.circle(image, (x + pw // 2, y + 4), 3, colour(rng, (0.6, 1), (0.5, 1)).tolist(), -1, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (150, 152, 155), max(3, h // 40))
    return image


def radiator(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """White ribs."""
    h, w = shape
    ribs = 0.75 + 0.25 * np.abs(np.sin(np.linspace(0, np.pi * max(4, w // 18), w)))
    image = np.broadcast_to((np.array([228.0, 232.0, 235.0]) * ribs[None, :, None]), (h, w, 3)).copy()
    image[: h // 12] = 225
    image[-h // 12 :] = 200
    return image.astype(np.uint8)


def keyboard(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Rows of keys."""
    h, w = shape
    ground, key, ink = (25, (60,) * 3, (180,) * 3) if rng.random() < 0.6 else (205, (240,) * 3, (60,) * 3)
    image = np.full((h, w, 3), ground, np.uint8)
    for r in range(5):
        x = 3
        while x < w - 6:
            width = int(rng.choice([1, 1, 1, 1, 1.6]) * w / 17)
            y0, y1 = 3 + r * (h - 6) // 5, (r + 1) * (h - 6) // 5
            cv2.rectangle(image, (x, y0), (min(x + width - 2, w - 4), y1), key, -1)
            cv2.putText(image, chr(65 + int(rng.integers(26))), (x + 2, y1 - 3), FONTS[0], 0.3, ink)
            x += width
    return image


def rug(rng: Rng, shape: tuple[int, int]) -> np.ndarray:
    """Bordered carpet with a mirrored pattern."""
    h, w = shape
    quarter = dead_leaves(rng, (h // 2 + 1, w // 2 + 1), 260)
    image = np.hstack([quarter, quarter[:, ::-1]])
    image = np.vstack([image, image[::-1]])[:h, :w].copy()
    for k in range(3):
        inset, tone = int((k + 0.4) * min(h, w) * 0.05), colour(rng, (0.2, 0.8), (0.2, 0.9)).tolist()
        cv2.rectangle(image, (inset, inset), (w - 1 - inset, h - 1 - inset), tone, 4)
    return shaded(image.astype(np.float32), 1 + 0.12 * fractal(rng, 0.2, shape))
