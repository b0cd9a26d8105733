"""Geometry of a corridor around the drone: free space ahead and walls."""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from edgeslam_torch.navigation.corridor.trail import SAME_M, aside
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.exit_tracker import SAME_COS
from edgeslam_torch.types import FloatArray

_BERTH_M = 0.55
"""Clearance of the space that is followed: a corridor is wider than twice this, a doorway is not."""
SMEARED_BERTH_M = 0.4
"""The same for side corridors, whose mouths appear narrowed by depth errors, if nothing else leads on."""
_ARRIVED_M = 0.6
"""Minimum free distance ahead."""
_STRIP_M = 0.6
"""Half width of the strip straight ahead."""
_NEAREST_M = 1.0
"""Maximum distance from the drone to the space that it follows."""
_NARROW_M = 0.3
"""Clearance straight ahead, where underestimated depth may narrow the corridor to a door's width."""
_WALL_M, _ABREAST_M = 2.0, 0.5
"""Distance at which a wall ahead ends a corridor, and half width of the search for it: the wall may have a door."""


def wide(layer: Layer, here_w: FloatArray, berth_m: float = _BERTH_M) -> np.ndarray:
    """Cells ``(N, 2)`` of the wide free space around the drone."""
    return _part(layer, here_w, berth_m)


def is_ahead(p_w: FloatArray, here_w: FloatArray, axis: FloatArray) -> np.ndarray:
    """Which of the points ``(N, 2)`` are ahead and far enough."""
    step = p_w - here_w
    along = step @ axis
    return np.asarray((along > _ARRIVED_M) & (along > SAME_COS * np.linalg.norm(step, axis=1)))


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
    last = cells[along > along.max() - SAME_M]
    left = aside(layer.centres(last), axis)
    return last[[int(np.argmin(np.abs(left - np.median(left))))]]


def is_walled(layer: Layer, here_w: FloatArray, axis: FloatArray) -> bool:
    """Whether an obstacle is close ahead, within `_ABREAST_M` to each side."""
    steps = np.arange(0.3, _WALL_M, 0.5 * layer.cell_m)
    left = np.array([-axis[1], axis[0]])
    rays = here_w + steps[:, None, None] * axis + np.array([[-_ABREAST_M], [0.0], [_ABREAST_M]]) * left
    cells = layer.cells(rays)
    return bool(layer.solid[cells[..., 0], cells[..., 1]].any())


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
