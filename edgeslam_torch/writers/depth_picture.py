"""Depth as a picture with a scale bar in metres."""

import math

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray
from edgeslam_torch.writers.raster_axes import BACKGROUND, INK, Image, text, text_size

BAR_PX, LABELS_PX = 12, 18
"""Heights of the colour bar and of its labels."""
_LABEL_SIZE = 0.4


def colour(depth_m: FloatArray) -> Image:
    """Inverse depth in colours above a scale bar in metres.

    Args:
        depth_m: ``(H, W)`` [m]; unknown depth, which is black, is not finite or not positive.

    Returns:
        ``(H + 30, W, 3)`` BGR; near is red and far blue. The colours reach from the 2nd to the 98th percentile.
    """
    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.zeros(depth_m.shape, np.float32)
    inverse[known] = 1.0 / depth_m[known]
    low, high = np.percentile(inverse[known], (2, 98)) if known.any() else (0.0, 1.0)
    if high < 1.01 * low:  # a single depth
        low, high = low / 1.005, high * 1.005
    level = np.clip((inverse - low) / (high - low) * 255.0, 0, 255).astype(np.uint8)
    picture = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO))
    picture[~known] = 0
    return np.vstack([picture, _scale_bar(depth_m.shape[1], low, high, bool(known.any()))])


def _scale_bar(width: int, low: float, high: float, known: bool) -> Image:
    """Colours from far (left) to near with round distances below, ``(30, width, 3)`` BGR; linear in 1/m."""
    bar = np.full((BAR_PX + LABELS_PX, width, 3), BACKGROUND[::-1], np.uint8)
    middle = BAR_PX + LABELS_PX / 2
    if not known:
        text(bar, "no depth", (4, middle), _LABEL_SIZE, anchor=(0.0, 0.5))
        return bar
    ramp = np.linspace(0, 255, width).astype(np.uint8)
    bar[:BAR_PX] = cv2.applyColorMap(np.tile(ramp, (BAR_PX, 1)), cv2.COLORMAP_TURBO)
    taken = -np.inf
    for metres in round_distances(low, high):
        x = (1.0 / metres - low) / (high - low) * (width - 1)
        label = f"{metres:g} m"
        half = text_size(label, _LABEL_SIZE)[0] / 2
        if x - half < max(taken + 6, 0) or x + half > width:
            continue
        bar[BAR_PX : BAR_PX + 3, round(x)] = INK[::-1]
        text(bar, label, (x, middle + 1), _LABEL_SIZE, anchor=(0.5, 0.5))
        taken = x + half
    return bar


def round_distances(low: float, high: float) -> list[float]:
    """Distances [m] to mark between two inverse distances [1/m], far to near, at least three.

    1, 2, 5 times powers of ten where the range is wide, else multiples of the largest such step that is small enough.
    """
    nearest, farthest = 1.0 / high, 1.0 / max(low, 1e-3)
    powers = range(math.floor(math.log10(nearest)), math.ceil(math.log10(farthest)) + 1)
    marks = [m for m in (s * 10.0**p for p in powers for s in (1, 2, 5)) if nearest <= m <= farthest]
    steps = (s * 10.0**p for p in range(powers[-1], -9, -1) for s in (5, 2, 1))
    while len(marks) < 3:
        step = next(steps)
        marks = [k * step for k in range(math.ceil(nearest / step), math.floor(farthest / step) + 1)]
    return sorted((round(m, 9) for m in marks), reverse=True)
