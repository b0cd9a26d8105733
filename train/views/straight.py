"""Edge pixels and straight pieces of edges, as the self-supervised terms want them: fixed numbers, padded
with -1."""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

MIN_LENGTH_PX = 18
MAX_BEND_PX = 0.7
"""Largest distance of a contour's pixel from its chord."""


def straight_edges(
    image: NDArray[np.uint8], edges: int, arms: int, points: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Canny pixels and straight pieces of an image.

    Args:
        image: ``(H, W, 3)`` BGR.
        edges: Edge pixels to draw.
        arms: Straight pieces to draw; even.
        points: Points on each.
        rng: Draws them.

    Returns:
        Pixels ``(edges, 2)`` and points ``(arms, points, 2)``, float32; rows of -1 where there are too few.
    """
    mask = np.asarray(cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 50, 120), np.uint8)
    v, u = np.nonzero(mask)
    pixels = np.full((edges, 2), -1.0, np.float32)
    if len(u):
        pick = rng.choice(len(u), min(edges, len(u)), replace=False)
        pixels[: len(pick)] = np.stack([u[pick], v[pick]], 1)
    pieces = np.full((arms, points, 2), -1.0, np.float32)
    found = _pieces(mask)
    if found:
        for row, k in enumerate(rng.permutation(len(found))[:arms]):
            a, b = found[k]
            pieces[row] = a + np.linspace(0.05, 0.95, points)[:, None] * (b - a)
    return pixels, pieces


def _pieces(mask: NDArray[np.uint8]) -> list[tuple[FloatArray, FloatArray]]:
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in contours:
        if len(contour) < MIN_LENGTH_PX:
            continue
        corners = cv2.approxPolyDP(contour, MAX_BEND_PX, closed=False)[:, 0].astype(np.float32)
        for a, b in zip(corners, corners[1:], strict=False):
            if np.hypot(*(b - a)) >= MIN_LENGTH_PX:
                found.append((a, b))
    return found
