"""Pixels of a pinhole and derivatives by differences: truths that need none of the package's formulas."""

from collections.abc import Callable

import numpy as np

from edgeslam_torch.types import Edges, FloatArray


def pixels(p_c: FloatArray, K: tuple[float, float, float, float]) -> FloatArray:
    """Pixels ``(N, 2)`` of points ``(N, 3)`` in front of a camera ``(fx, fy, cx, cy)``."""
    return p_c[:, :2] / p_c[:, 2:] * K[:2] + np.array(K[2:])


def derivative(function: Callable[[FloatArray], FloatArray | float], size: int, step: float = 1e-6) -> FloatArray:
    """Of a function of small steps ``(size,)``, at zero, by central differences: one column a component."""
    steps = step * np.eye(size)
    return np.stack([np.subtract(function(d), function(-d)) / (2.0 * step) for d in steps], -1)


def edges_along(uv: FloatArray, along: FloatArray, size: tuple[int, int]) -> tuple[Edges, FloatArray]:
    """Edges in an image of ``(width, height)`` where lines pass ``uv`` in directions ``along``, both ``(N, 2)``: whole
    pixels, each once, normals to the left; and the index of each among the lines' points."""
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.stack((along[:, 1], -along[:, 0]), 1)
    pixel, first = np.unique(np.rint(uv), axis=0, return_index=True)
    inside = (pixel >= 0).all(1) & (pixel < np.array(size)).all(1)
    first = first[inside]
    colours = np.zeros((len(first), 3), np.uint8)
    return Edges(pixel[inside].astype(np.float32), normal[first].astype(np.float32), colours), first
