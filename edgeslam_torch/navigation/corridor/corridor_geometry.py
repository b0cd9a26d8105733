"""Geometry of a corridor around the drone: free space ahead, walls, and openings in the side walls."""

import math
from collections.abc import Callable

import numpy as np
from scipy import ndimage

from edgeslam_torch.navigation.corridor.trail import PASSED_M, aside
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.openings.wall_frame import runs
from edgeslam_torch.types import FloatArray

_BERTH_M = 0.55
"""Clearance of the space that is followed: a corridor is wider than twice this, a doorway is not."""
SMEARED_BERTH_M = 0.4
"""The same for side corridors, whose mouths appear narrowed by depth errors, if nothing else leads on."""
_ARRIVED_M = 0.6
"""Minimum free distance ahead."""
_NARROW_M = 0.3
"""Clearance straight ahead, where underestimated depth may narrow the corridor to a door's width."""
_STRIP_M = 0.6
"""Half width of the strip straight ahead."""
_NEAREST_M = 1.0
"""Maximum distance from the drone to the space that it follows."""
_AHEAD_COS = math.cos(math.radians(35.0))
_SAME_M = 0.3
"""Distances along the axis that differ by less count as equal."""
_WALL_M, _ABREAST_M = 2.0, 0.5
"""Distance at which a wall ahead ends a corridor, and half width of the search for it: the wall may have a door."""
_BESIDE_M, _KNOWN_SHARE = (1.1, 3.3), 0.75
"""Distances back from the end that a turn there sees only at a grazing angle; share of a known wall."""
_SPECK_M2 = 0.08
"""Minimum area of a wall; smaller occupied regions are depth noise."""
_BACK_M, _MOUTH_M = 6.0, 1.2
"""Distance back from the end within which side openings are searched, and distance of the goal into them."""
_THROUGH_M = (-0.3, 1.2)
"""Range beyond the goal in which the path flown shows that the drone came through this opening."""


def wide(layer: Layer, here_w: FloatArray, berth_m: float = _BERTH_M) -> np.ndarray:
    """Cells ``(N, 2)`` of the wide free space around the drone."""
    return _part(layer, here_w, berth_m)


def is_ahead(p_w: FloatArray, here_w: FloatArray, axis: FloatArray) -> np.ndarray:
    """Which of the points ``(N, 2)`` are ahead and far enough."""
    step = p_w - here_w
    along = step @ axis
    return np.asarray((along > _ARRIVED_M) & (along > _AHEAD_COS * np.linalg.norm(step, axis=1)))


def straight(layer: Layer, here_w: FloatArray, axis: FloatArray, before_m: float) -> np.ndarray:
    """Reachable cells ``(N, 2)`` straight ahead, nearer than ``before_m``, also through narrow space."""
    cells = _part(layer, here_w, _NARROW_M, lambda p_w: np.abs(aside(p_w - here_w, axis)) < _STRIP_M)
    along = (layer.centres(cells) - here_w) @ axis
    return cells[(along > _ARRIVED_M) & (along < before_m)]


def far_middle(layer: Layer, cells: np.ndarray, axis: FloatArray) -> np.ndarray:
    """Middle one ``(1, 2)`` of the cells ``(N, 2)`` that lie farthest along an axis; none without cells."""
    if len(cells) == 0:
        return cells
    along = layer.centres(cells) @ axis
    last = cells[along > along.max() - _SAME_M]
    left = aside(layer.centres(last), axis)
    return last[[int(np.argmin(np.abs(left - np.median(left))))]]


def is_walled(layer: Layer, here_w: FloatArray, axis: FloatArray) -> bool:
    """Whether an obstacle is close ahead, within `_ABREAST_M` to each side."""
    steps = np.arange(0.3, _WALL_M, 0.5 * layer.cell_m)
    left = np.array([-axis[1], axis[0]])
    rays = here_w + steps[:, None, None] * axis + np.array([[-_ABREAST_M], [0.0], [_ABREAST_M]]) * left
    cells = layer.cells(rays)
    return bool(layer.solid[cells[..., 0], cells[..., 1]].any())


def mouths(layer: Layer, end_w: FloatArray, axis: FloatArray, flown_w: FloatArray) -> np.ndarray:
    """Goal cells ``(N, 2)`` in openings of the side walls, as wide as a corridor, before the end of a corridor.

    In passing, the camera hardly sees a corridor that turns off: its far corner leaves the field of view.

    Args:
        layer: Current layer.
        end_w: ``(2,)`` end of the corridor.
        axis: ``(2,)`` unit vector of its direction there.
        flown_w: ``(N, 2)`` path flown, a metre apart; the opening that the drone came through is excluded.
    """
    along = np.arange(0.0, _BACK_M, layer.cell_m)
    walls, places = _walls(layer), []
    for left in (np.array([-axis[1], axis[0]]), np.array([axis[1], -axis[0]])):
        for low, high in runs(~_meet(walls, layer, end_w - along[:, None] * axis, left)):
            width_m = (high - low) * layer.cell_m
            if low > 0 and high < len(along) and 2.0 * _BERTH_M <= width_m <= WIDEST_M:
                place = end_w - 0.5 * (low + high) * layer.cell_m * axis + _MOUTH_M * left
                along_m, out_m = np.array([axis, left]) @ (flown_w - place).T
                through = (np.abs(along_m) < 0.5 * width_m) & (_THROUGH_M[0] < out_m) & (out_m < _THROUGH_M[1])
                if not through.any():
                    places.append(place)
    return layer.cells(np.array(places).reshape(-1, 2))


def unknown_sides(layer: Layer, end_w: FloatArray, axis: FloatArray) -> list[FloatArray]:
    """Side directions ``(2,)`` before a corridor's end in which mostly no wall is known: a corridor may turn off."""
    along = np.arange(*_BESIDE_M, layer.cell_m)
    walls, from_w = _walls(layer), end_w - along[:, None] * axis
    sides = (np.array([-axis[1], axis[0]]), np.array([axis[1], -axis[0]]))
    return [left for left in sides if _meet(walls, layer, from_w, left).mean() < _KNOWN_SHARE]


def _meet(walls: np.ndarray, layer: Layer, from_w: FloatArray, left: FloatArray) -> np.ndarray:
    """Which of the rays from points ``(N, 2)`` to one side meet a wall within half the widest corridor."""
    out = np.arange(0.0, PASSED_M, 0.5 * layer.cell_m)
    cells = layer.cells(from_w[:, None] + out[:, None] * left)
    return np.asarray(walls[cells[..., 0], cells[..., 1]].any(axis=1))


def _walls(layer: Layer) -> np.ndarray:
    """``(X, Y)`` bool: occupied cells without small regions."""
    parts, _ = ndimage.label(layer.solid, np.ones((3, 3)))
    return np.asarray(layer.solid & (np.bincount(parts.ravel())[parts] * layer.cell_m**2 >= _SPECK_M2))


def _part(
    layer: Layer, here_w: FloatArray, berth_m: float, among: Callable[[FloatArray], np.ndarray] | None = None
) -> np.ndarray:
    """Cells ``(N, 2)`` of the connected free space with this clearance around the drone."""
    cells = np.argwhere(layer.free & (layer.from_solid_m >= berth_m))
    if among is not None:
        cells = cells[among(layer.centres(cells))]
    if len(cells) == 0:
        return cells
    away = np.linalg.norm(layer.centres(cells) - here_w, axis=1)
    nearest = int(np.argmin(away))
    if away[nearest] > _NEAREST_M:
        return cells[:0]
    open_ = np.zeros(layer.free.shape, dtype=bool)
    open_[tuple(cells.T)] = True
    parts, _ = ndimage.label(open_)
    return np.asarray(np.argwhere(parts == parts[tuple(cells[nearest])]))
