"""Axes drawn into an image, with a tenth of a plotting library's start-up time."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

Image = NDArray[np.uint8]
"""``(H, W, 3)`` RGB."""
Colour = tuple[int, int, int]

BACKGROUND: Colour = (17, 20, 26)
INK: Colour = (201, 209, 217)
FRAME: Colour = (58, 65, 77)
GRID: Colour = (38, 44, 54)

_FONT = cv2.FONT_HERSHEY_SIMPLEX  # OpenCV 5 draws its TrueType font for this constant
_SUBPIXEL_BITS = 4
_FAR_PX = 1e5
"""Clipping distance; OpenCV's coordinates are 32-bit fixed point."""
_TICK_GAP_PX = 62
"""Minimum distance between ticks."""


@dataclass(frozen=True, slots=True)
class Axes:
    """A rectangle of an image with equal scale on both axes; y points up."""

    image: Image
    """View of the rectangle within the picture."""
    low: FloatArray
    """``(2,)`` data at the lower left corner."""
    scale: float
    """Pixels per unit."""

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels ``(N, 2)`` of data ``(N, 2)``, y down from the rectangle's upper edge."""
        p = (points - self.low) * self.scale
        p[:, 1] = self.image.shape[0] - p[:, 1]
        return np.clip(p, -_FAR_PX, _FAR_PX)


def axes_around(image: Image, points: FloatArray, margin: float = 0.05) -> Axes:
    """Axes that show all finite points ``(N, 2)`` with a margin (a share of their extent), in the image's middle."""
    finite = points[np.isfinite(points).all(axis=1)]
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(2), np.ones(2))
    span = (high - low).max()
    half = (0.5 + margin) * np.maximum(high - low, 1e-3 * span if span > 0 else 1.0)
    size = np.array([image.shape[1], image.shape[0]])
    scale = float((size / (2.0 * half)).min())
    return Axes(image, 0.5 * (low + high) - 0.5 * size / scale, scale)


def draw_grid(axes: Axes, picture: Image, corner: tuple[int, int]) -> None:
    """Grid lines, tick labels and a frame.

    Args:
        axes: Part of ``picture``.
        picture: The whole picture, for labels outside the axes.
        corner: Upper left pixel of the axes in the picture.
    """
    height, width = axes.image.shape[:2]
    x0, y0 = corner
    step = _tick_step(_TICK_GAP_PX / axes.scale)
    for x in _ticks(axes.low[0], width / axes.scale, step):
        u = round((x - axes.low[0]) * axes.scale)
        axes.image[:, min(u, width - 1)] = GRID
        picture[y0 + height : y0 + height + 5, min(x0 + u, x0 + width - 1)] = INK
        text(picture, _label(x, step), (x0 + u, y0 + height + 14), 0.42, anchor=(0.5, 0.5))
    for y in _ticks(axes.low[1], height / axes.scale, step):
        v = height - round((y - axes.low[1]) * axes.scale)
        axes.image[min(v, height - 1)] = GRID
        picture[min(y0 + v, y0 + height - 1), x0 - 5 : x0] = INK
        text(picture, _label(y, step), (x0 - 9, y0 + v), 0.42, anchor=(1.0, 0.5))
    draw_frame(picture, corner, (width, height))


def draw_frame(picture: Image, corner: tuple[int, int], size: tuple[int, int]) -> None:
    """A thin frame around a rectangle."""
    (x, y), (width, height) = corner, size
    cv2.rectangle(picture, (x - 1, y - 1), (x + width, y + height), FRAME, 1)


def draw_points(axes: Axes, points: FloatArray, colour: FloatArray, cell_px: int) -> None:
    """Points ``(N, 2)`` as squares in their mean colour ``(N, 3)`` of [0, 1], denser ones more opaque."""
    height, width = axes.image.shape[:2]
    columns, rows = -(-width // cell_px), -(-height // cell_px)
    cell = np.floor(axes.pixels(points) / cell_px).astype(np.int64)
    inside = ((cell >= 0) & (cell < (columns, rows))).all(axis=1)
    flat = cell[inside, 1] * columns + cell[inside, 0]
    count = np.bincount(flat, minlength=rows * columns)
    full = np.flatnonzero(count)
    many = count[full]
    rgb = np.empty((len(full), 3))
    for channel in range(3):
        rgb[:, channel] = np.bincount(flat, weights=colour[inside, channel], minlength=rows * columns)[full] / many
    rgb = 255.0 * (0.30 + 0.70 * rgb)  # lighten dark colours, keeping their hue, to be visible on the dark background
    alpha = (0.45 + 0.55 * np.minimum(many / 3.0, 1.0))[:, None]
    v, u = np.divmod(full, columns)
    for dv, du in np.ndindex(cell_px, cell_px):
        y, x = v * cell_px + dv, u * cell_px + du
        here = (y < height) & (x < width)
        y, x, share = y[here], x[here], alpha[here]
        axes.image[y, x] = np.rint(share * rgb[here] + (1.0 - share) * axes.image[y, x]).astype(np.uint8)


def draw_path(axes: Axes, points: FloatArray, colour: Colour, width_px: int) -> None:
    """A line through points ``(N, 2)``; non-finite points are skipped."""
    fixed = _fixed(axes.pixels(points[np.isfinite(points).all(axis=1)]))
    if len(fixed) > 1:
        cv2.polylines(axes.image, [fixed[:, None]], False, colour, width_px, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_dot(axes: Axes, point: FloatArray, colour: Colour, radius_px: float) -> None:
    """A filled circle at ``(2,)``."""
    if np.isfinite(point).all():
        _dot(axes.image, axes.pixels(point[None])[0], colour, radius_px)


def draw_legend(axes: Axes, entries: list[tuple[str, Colour, bool]]) -> None:
    """Names with their colours in the upper right corner; True for a line, False for a dot."""
    row, left = 21, 44
    width = left + 10 + max(text_size(name, 0.42)[0] for name, _, _ in entries)
    height = row * len(entries) + 8
    x = axes.image.shape[1] - width - 6
    box = axes.image[6 : 6 + height, x : x + width]
    box[:] = BACKGROUND
    cv2.rectangle(box, (0, 0), (width - 1, height - 1), FRAME, 1)
    for i, (name, colour, is_line) in enumerate(entries):
        y = 4 + row * i + row // 2
        if is_line:
            cv2.line(box, (9, y), (34, y), colour, 2, cv2.LINE_AA)
        else:
            _dot(box, np.array([21.5, y]), colour, 4.5)
        text(box, name, (left, y), 0.42, anchor=(0.0, 0.5))


def text(
    image: Image, words: str, at: tuple[float, float], size: float, anchor: tuple[float, float], upright: bool = False
) -> None:
    """Write in `INK`.

    Args:
        image: Image to write into; text outside is clipped.
        words: One line; undecodable bytes of file names become question marks.
        at: Pixel.
        size: OpenCV's font scale; 0.5 is some 15 px.
        anchor: Anchor within the text, from 0 (left, top) to 1 (right, bottom).
        upright: Rotated by 90 degrees.
    """
    words = words.encode("utf-8", errors="replace").decode("utf-8")  # OpenCV aborts on a lone surrogate
    width, height = text_size(words, size)
    pad = 2 + height // 2  # descenders and glyph overhang
    cover = np.zeros((height + 2 * pad, width + 2 * pad, 3), dtype=np.uint8)
    cv2.putText(cover, words, (pad, pad + height), _FONT, size, (255, 255, 255), 1, cv2.LINE_AA)
    if upright:
        cover, width, height = np.rot90(cover), height, width
    x, y = (round(a - share * extent) - pad for a, share, extent in zip(at, anchor, (width, height), strict=True))
    top, left = max(0, -y), max(0, -x)
    target = image[max(0, y) : max(0, y + cover.shape[0]), max(0, x) : max(0, x + cover.shape[1])]
    alpha = cover[top : top + target.shape[0], left : left + target.shape[1]].astype(np.float32) / 255.0
    target[:] = np.rint(alpha * np.array(INK, np.float32) + (1.0 - alpha) * target).astype(np.uint8)


def text_size(words: str, size: float) -> tuple[int, int]:
    """Width and height above the base line [px]."""
    (width, _), _ = cv2.getTextSize(words, _FONT, size, 1)
    (_, height), _ = cv2.getTextSize("0", _FONT, size, 1)
    return width, height


def _dot(image: Image, at: FloatArray, colour: Colour, radius_px: float) -> None:
    u, v = (int(x) for x in _fixed(at))
    cv2.circle(image, (u, v), round(radius_px * 2**_SUBPIXEL_BITS), colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed(pixels: FloatArray) -> NDArray[np.int32]:
    """For OpenCV's drawing functions, whose pixel centres lie at integers."""
    return np.rint((pixels - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)


def _tick_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is at least ``least``."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least * (1 - 1e-9))


def _ticks(low: float, extent: float, step: float) -> list[float]:
    first, last = math.ceil(low / step), math.floor((low + extent) / step)
    return [i * step for i in range(first, last + 1)]


def _label(value: float, step: float) -> str:
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value:.{digits}f}" if abs(value) < 1e6 else f"{value:.4g}"
