"""Edge pixels and straight edge segments of an image, in arrays of fixed size for the self-supervised terms."""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

MIN_LENGTH_PX = 18
"""Minimum length of a segment."""
MAX_BEND_PX = 0.7
"""Maximum distance of a contour's pixel from its chord."""


def straight_edges(
    image: NDArray[np.uint8], edges: int, arms: int, points: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random samples of Canny pixels and of straight segments.

    Args:
        image: ``(H, W, 3)`` BGR.
        edges: Number of edge pixels.
        arms: Number of segments; even.
        points: Number of points on each segment.
        rng: Chooses pixels and segments.

    Returns:
        Pixels ``(edges, 2)`` and points ``(arms, points, 2)``, float32; padded with -1.
    """
    mask = np.asarray(cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 50, 120), np.uint8)
    v, u = np.nonzero(mask)
    pixels = np.full((edges, 2), -1.0, np.float32)
    if len(u):
        pick = rng.choice(len(u), min(edges, len(u)), replace=False)
        pixels[: len(pick)] = np.stack([u[pick], v[pick]], 1)
    pieces = np.full((arms, points, 2), -1.0, np.float32)
    found = _segments(mask)
    if found:
        for row, k in enumerate(rng.permutation(len(found))[:arms]):
            a, b = found[k]
            pieces[row] = a + np.linspace(0.05, 0.95, points)[:, None] * (b - a)
    return pixels, pieces


def _segments(mask: NDArray[np.uint8]) -> list[tuple[FloatArray, FloatArray]]:
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
