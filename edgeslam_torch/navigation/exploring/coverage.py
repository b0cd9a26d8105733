"""Which borders of the free space a camera has looked at from before: what it passes it sees aslant, and of a door
between two jambs nothing."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import FARTHEST_M, FIELD_RAD
from edgeslam_torch.types import FloatArray

_NEAREST_M = 0.6
"""From nearer less than a door's width is in a picture."""
_SQUARELY_COS = math.cos(math.radians(40.0))
"""Angle to a border's normal up to which it is looked at from before: through a door in a wall of a hand's breadth half
a metre is seen."""
_BODY_M = 0.15
"""What of the free space is narrower than twice this is a slit between rays."""
_LARGE_M2 = 0.5
"""What is not free and smaller is furniture: no wall, no door."""
_SMOOTH_CELLS = 2.0
"""Of the free space, so that its border has a direction."""
_APART_M, _APART_RAD = 0.2, math.radians(8.0)
"""Views nearer than both of these show the same."""


@dataclass(frozen=True, slots=True)
class Borders:
    """Where free space ends, at something solid or at what was never seen, cell by cell."""

    p_w: FloatArray
    """``(N, 2)`` [m]."""
    normal_w: FloatArray
    """``(N, 2)`` unit vectors into the free space."""
    cell_m: float
    """Length of each."""

    def __getitem__(self, some: np.ndarray) -> "Borders":
        return Borders(self.p_w[some], self.normal_w[some], self.cell_m)

    def before(self, here_w: FloatArray) -> np.ndarray:
        """``(M, N)`` whether each is seen from before, and not too far, from places ``(M, 2)``."""
        step = here_w[:, None] - self.p_w
        away = np.linalg.norm(step, axis=-1)
        return (away > _NEAREST_M) & (away < FARTHEST_M) & ((step * self.normal_w).sum(-1) > _SQUARELY_COS * away)


def borders(layer: Layer, here_w: FloatArray) -> Borders:
    """Those of the free space that a place ``(2,)`` is in."""
    parts, _ = ndimage.label(layer.clearance_m >= _BODY_M)
    i, j = layer.cells(here_w)
    around = parts[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3]
    mine = ndimage.binary_dilation(np.isin(parts, around[around > 0]), iterations=2) & layer.free
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
    """Remembers from where it looked, and whereto."""

    _views: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """``(V, 3)`` place [m] and heading [rad]."""

    def note(self, state: DroneState) -> None:
        """What a camera shows now counts as looked at; where the pose is carried, nothing does."""
        if not state.tracked:
            return
        new = np.array([*state.p_w[:2], state.yaw_rad])
        near = np.linalg.norm(self._views[:, :2] - new[:2], axis=1) < _APART_M
        alike = np.abs(wrapped(self._views[:, 2] - new[2])) < _APART_RAD
        if not (near & alike).any():
            self._views = np.concatenate([self._views, new[None]])

    def unlooked(self, all_: Borders) -> Borders:
        """Those that no view has shown from before."""
        if not len(self._views) or not len(all_.p_w):
            return all_
        step = all_.p_w - self._views[:, None, :2]
        bearing = np.arctan2(step[..., 1], step[..., 0]) - self._views[:, None, 2]
        shown = all_.before(self._views[:, :2]) & (np.abs(wrapped(bearing)) < FIELD_RAD)
        return all_[np.flatnonzero(~shown.any(axis=0))]

    def carry(self, update: MapUpdate) -> None:
        """Take the places along with the map; directions of level flight hardly turn with it."""
        self._views[:, :2] = update.points(self._views[:, :2])
