"""Coverage: borders of free space that the camera has seen frontally; at a grazing angle a door is invisible."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import FARTHEST_M, FIELD_RAD
from edgeslam_torch.types import FloatArray

_NEAREST_M = 0.6
"""Minimum distance: from closer a door exceeds the field of view."""
_SQUARELY_COS = math.cos(math.radians(40.0))
"""Maximum angle to a border's normal for a frontal view: half a metre is visible through a door in a 10 cm wall."""
_BODY_M = 0.15
"""Half width below which free space is a gap between rays."""
_LARGE_M2 = 0.5
"""Smaller non-free regions are furniture, not walls."""
_SMOOTH_CELLS = 2.0
"""Smoothing of the free space for border normals [cells]."""
_SAME_VIEW_M, _SAME_VIEW_RAD = 0.2, math.radians(8.0)
"""Views closer than both of these are redundant."""


@dataclass(frozen=True, slots=True)
class Borders:
    """Border cells of free space, towards occupied or unknown cells."""

    p_w: FloatArray
    """``(N, 2)`` [m]."""
    normal_w: FloatArray
    """``(N, 2)`` unit normals into the free space."""
    cell_m: float
    """Length of each border cell [m]."""

    def __getitem__(self, some: np.ndarray) -> "Borders":
        return Borders(self.p_w[some], self.normal_w[some], self.cell_m)

    def before(self, here_w: FloatArray) -> np.ndarray:
        """``(M, N)`` whether each border is visible frontally and in range from points ``(M, 2)``."""
        step = here_w[:, None] - self.p_w
        away = np.linalg.norm(step, axis=-1)
        return (away > _NEAREST_M) & (away < FARTHEST_M) & ((step * self.normal_w).sum(-1) > _SQUARELY_COS * away)


def borders(layer: Layer, here_w: FloatArray) -> Borders:
    """Borders of the connected free space around a point ``(2,)``."""
    wide = layer.clearance_m >= _BODY_M
    mine = ndimage.binary_dilation(layer.part_around(wide, here_w), iterations=2) & layer.free
    closed, count = ndimage.label(~layer.free)
    sizes = np.bincount(closed.ravel(), minlength=count + 1) * layer.cell_m**2
    sizes[0] = 0.0
    edge = ndimage.binary_dilation(mine) & (sizes[closed] >= _LARGE_M2)
    cells = np.argwhere(edge)
    smooth = ndimage.gaussian_filter(mine.astype(np.float32), _SMOOTH_CELLS)
    normal = np.stack([g[edge] for g in np.gradient(smooth)], axis=1)
    length = np.linalg.norm(normal, axis=1)
    good = length > 1e-3
    facing = (normal[good] / length[good, None]).astype(np.float64)
    return Borders(layer.centres(cells[good]).reshape(-1, 2), facing, layer.cell_m)


@dataclass(slots=True)
class Coverage:
    """Record of camera positions and headings."""

    _places: Places = field(default_factory=Places)
    _headings: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(V,)`` [rad]; the effect of map corrections on them is negligible."""

    def note(self, state: DroneState) -> None:
        """Add the current view; dead-reckoned poses are left out."""
        if not state.tracked:
            return
        near = np.linalg.norm(self._places.p_w - state.p_w[:2], axis=1) < _SAME_VIEW_M
        similar = np.abs(wrapped(self._headings - state.yaw_rad)) < _SAME_VIEW_RAD
        if not (near & similar).any():
            self._places.add(state.views, state.p_w[:2])
            self._headings = np.append(self._headings, state.yaw_rad)

    def unlooked(self, all_: Borders) -> Borders:
        """Borders that no view has covered."""
        places_w = self._places.p_w
        step = all_.p_w - places_w[:, None]
        bearing = np.arctan2(step[..., 1], step[..., 0]) - self._headings[:, None]
        shown = all_.before(places_w) & (np.abs(wrapped(bearing)) < FIELD_RAD)
        return all_[np.flatnonzero(~shown.any(axis=0))]
