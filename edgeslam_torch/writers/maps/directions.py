"""Direction of the edge at each point of an edge map."""

import numpy as np
from scipy.spatial import cKDTree

from edgeslam_torch.types import FloatArray

_NEIGHBOURS = 12
_STRAIGHT = 3.0
"""Variance along the edge over that across it, as the camera sees them, from which on neighbours lie on a line."""


def edge_directions(p_w: FloatArray, centres_w: FloatArray) -> FloatArray:
    """Unit vectors along the edge, from the nearest points.

    Points are off along their viewing rays, more than edges are thick. So the line is found across the ray, as in an
    image, and its slope along the ray by regression.

    Args:
        p_w: Points ``(P, 3)``.
        centres_w: Cameras ``(K, 3)``; the nearest one's ray counts.

    Returns:
        ``(P, 3)`` float32; of both ways along an edge, the one whose largest component is positive. Zero where the
        neighbours lie on no line.
    """
    count = min(_NEIGHBOURS, len(p_w))
    if count < 3 or len(centres_w) == 0:
        return np.zeros((len(p_w), 3), np.float32)
    p, centres = np.asarray(p_w, np.float64), np.asarray(centres_w, np.float64)
    ray = p - centres[cKDTree(centres).query(p)[1]]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    near = p[cKDTree(p).query(p, k=count)[1]]
    near -= near.mean(axis=1, keepdims=True)
    depth = np.einsum("pki,pi->pk", near, ray)
    across = near - depth[..., None] * ray[:, None]
    variance, axes = np.linalg.eigh(across.transpose(0, 2, 1) @ across)  # the smallest is the ray's own, zero
    line = axes[:, :, 2]
    place = np.einsum("pki,pi->pk", across, line)
    slope = (place * depth).sum(axis=1) / np.maximum(variance[:, 2], 1e-18)
    direction = line + slope[:, None] * ray
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    largest = np.take_along_axis(direction, np.abs(direction).argmax(axis=1)[:, None], axis=1)
    straight = variance[:, 2] > _STRAIGHT * np.maximum(variance[:, 1], 1e-18)
    return (np.where(largest < 0, -direction, direction) * straight[:, None]).astype(np.float32)
