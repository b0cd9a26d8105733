"""Detour test: a gap that can be bypassed, as between two pillars in a room, is no exit."""

import cv2
import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.types import FloatArray

_AROUND_M = 2.0
"""Radius of the search: detours around furniture are shorter, two doors of one room are farther apart."""
_BODY_M = 0.1
"""Clearance of a detour; isolated free cells in a wall do not count."""
_SEAL_M, _ENDS_M = 0.15, 0.2
"""Half depth of the virtual plug in the opening, and its overlap beyond the ends."""
_SIDES_M = (0.25, 0.65)
"""Distances in front and behind at which connectivity is tested."""


def has_detour(layer: Layer, centre_w: FloatArray, normal_w: FloatArray, width_m: float) -> bool:
    """Whether known free space joins both sides within `_AROUND_M` when the opening is closed.

    Args:
        layer: Layer at the flight height.
        centre_w: ``(2,)`` centre of the opening [m].
        normal_w: ``(2,)`` unit normal.
        width_m: Width of the opening.
    """
    low, high = (layer.cells(centre_w + side * _AROUND_M) for side in (-1.0, 1.0))
    rows, columns = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)), indexing="ij")
    step = layer.centres(np.stack([rows, columns], axis=-1)) - centre_w
    across, along = step @ normal_w, np.abs(step @ np.array([-normal_w[1], normal_w[0]]))
    closed = (np.abs(across) < _SEAL_M) & (along < 0.5 * width_m + _ENDS_M)
    near = np.linalg.norm(step, axis=-1) < _AROUND_M
    open_ = (layer.clearance_m[rows, columns] >= _BODY_M) & near & ~closed
    _, parts = cv2.connectedComponents(open_.astype(np.uint8), connectivity=4)
    facing = open_ & (along < 0.25 * width_m) & (np.abs(across) > _SIDES_M[0]) & (np.abs(across) < _SIDES_M[1])
    before, behind = (np.unique(parts[facing & (side * across > 0.0)]) for side in (-1.0, 1.0))
    return bool(np.intersect1d(before, behind).size)
