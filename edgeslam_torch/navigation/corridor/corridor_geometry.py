"""What leads on from a place in a corridor: what is free, wide enough, and ahead; walls, and holes in them."""

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
"""Distance from every solid of what is followed: a corridor is wider than twice this, a doorway is not."""
SMEARED_BERTH_M = 0.4
"""The same where nothing else leads on, of a mouth of two metres that depth has made narrow."""
_ARRIVED_M = 0.6
"""Less free way ahead is none."""
_NARROW_M = 0.3
"""Distance from solids straight ahead, where depth that is too near makes a corridor as narrow as a door: what a drone
passes."""
_STRIP_M = 0.6
"""How far to each side of the drone straight ahead is."""
_NEAREST_M = 1.0
"""How far from the drone what it follows may begin."""
_AHEAD_COS = math.cos(math.radians(35.0))
_SAME_M = 0.3
"""Ends of ways that differ by less are as far."""
_WALL_M, _ABREAST_M = 2.0, 0.5
"""How near a wall ahead ends a corridor, and how far to each side it is looked for: there may be a door in it."""
_BESIDE_M, _KNOWN_SHARE = (1.1, 3.3), 0.75
"""Way back from the end along which a turn on the spot shows the sides aslant; what share of a wall is known of one."""
_SPECK_M2 = 0.08
"""Smaller solids, of a wrong depth, stand before what turns off; a wall between two doors is more."""
_BACK_M, _MOUTH_M = 6.0, 1.2
"""How far back from a wall ahead holes in the sides are looked for, and how far to the side it looks into them."""
_THROUGH_M = (-0.3, 1.2)
"""How far beyond there a way through a hole has been somewhere; one past it, along a side of the corridor, has not."""


def wide(layer: Layer, here_w: FloatArray, berth_m: float = _BERTH_M) -> np.ndarray:
    """Cells ``(N, 2)`` of the wide free space that a drone is in or beside."""
    return _part(layer, here_w, berth_m)


def is_ahead(p_w: FloatArray, here_w: FloatArray, axis: FloatArray) -> np.ndarray:
    """Which of the places ``(N, 2)`` are ahead, and worth the way."""
    step = p_w - here_w
    along = step @ axis
    return np.asarray((along > _ARRIVED_M) & (along > _AHEAD_COS * np.linalg.norm(step, axis=1)))


def straight(layer: Layer, here_w: FloatArray, axis: FloatArray, before_m: float) -> np.ndarray:
    """Cells ``(N, 2)`` straight ahead that a drone reaches, through what is narrow, nearer than ``before_m``."""
    cells = _part(layer, here_w, _NARROW_M, lambda p_w: np.abs(aside(p_w - here_w, axis)) < _STRIP_M)
    along = (layer.centres(cells) - here_w) @ axis
    return cells[(along > _ARRIVED_M) & (along < before_m)]


def far_middle(layer: Layer, cells: np.ndarray, axis: FloatArray) -> np.ndarray:
    """Of the cells ``(N, 2)`` that lie farthest along an axis the one in the middle, ``(1, 2)``; or none."""
    if len(cells) == 0:
        return cells
    along = layer.centres(cells) @ axis
    last = cells[along > along.max() - _SAME_M]
    left = aside(layer.centres(last), axis)
    return last[[int(np.argmin(np.abs(left - np.median(left))))]]


def is_walled(layer: Layer, here_w: FloatArray, axis: FloatArray) -> bool:
    """Whether something solid is close ahead, or to a side of what is ahead."""
    steps = np.arange(0.3, _WALL_M, 0.5 * layer.cell_m)
    left = np.array([-axis[1], axis[0]])
    rays = here_w + steps[:, None, None] * axis + np.array([[-_ABREAST_M], [0.0], [_ABREAST_M]]) * left
    cells = layer.cells(rays)
    return bool(layer.solid[cells[..., 0], cells[..., 1]].any())


def mouths(layer: Layer, end_w: FloatArray, axis: FloatArray, flown_w: FloatArray) -> np.ndarray:
    """Cells ``(N, 2)`` where a side of a corridor that ended before a wall has a hole as wide as a corridor.

    What turns off is hardly seen in passing: a picture ends before its far corner comes into it.

    Args:
        layer: What is known.
        end_w: ``(2,)`` where it ended.
        axis: ``(2,)`` unit vector of its direction there.
        flown_w: ``(N, 2)`` the way, a metre apart: a hole that it came through leads back.
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
    """Directions ``(2,)`` to the sides of a corridor before its end in which most of what is there is not known to be
    a wall: what turns off may be there."""
    along = np.arange(*_BESIDE_M, layer.cell_m)
    walls, from_w = _walls(layer), end_w - along[:, None] * axis
    sides = (np.array([-axis[1], axis[0]]), np.array([axis[1], -axis[0]]))
    return [left for left in sides if _meet(walls, layer, from_w, left).mean() < _KNOWN_SHARE]


def _meet(walls: np.ndarray, layer: Layer, from_w: FloatArray, left: FloatArray) -> np.ndarray:
    """Which of the rays from places ``(N, 2)`` to one side meet a wall within half the widest corridor."""
    out = np.arange(0.0, PASSED_M, 0.5 * layer.cell_m)
    cells = layer.cells(from_w[:, None] + out[:, None] * left)
    return np.asarray(walls[cells[..., 0], cells[..., 1]].any(axis=1))


def _walls(layer: Layer) -> np.ndarray:
    """``(X, Y)`` bool: what is solid, less specks."""
    parts, _ = ndimage.label(layer.solid, np.ones((3, 3)))
    return np.asarray(layer.solid & (np.bincount(parts.ravel())[parts] * layer.cell_m**2 >= _SPECK_M2))


def _part(
    layer: Layer, here_w: FloatArray, berth_m: float, among: Callable[[FloatArray], np.ndarray] | None = None
) -> np.ndarray:
    """Cells ``(N, 2)`` of the part of free space away from solids that the drone is in or beside."""
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
