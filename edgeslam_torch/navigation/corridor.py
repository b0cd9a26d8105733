"""The task of following a corridor, round its corners, to where it ends or opens into a room."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from edgeslam_torch.navigation.exploring.frontiers import Looks, frontiers
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.sight import Sight
from edgeslam_torch.navigation.tasks import LooksAhead
from edgeslam_torch.types import FloatArray

_BERTH_M = 0.55
"""Distance from every solid that it keeps: a corridor is wider than twice this, a doorway is not."""
_TURN_COST_M = 6.0
"""A corridor that goes on straight ahead is followed before one that turns off square, as far as a drone sees."""
_HEADING_M = 1.0
"""Way over which the direction of flight is taken."""
_PASSED_M = 0.9
"""What is unseen within this of the way that was flown is no way on: it is above or below the picture."""
_ARRIVED_M = 0.6
_LEAST_M = 1.0
"""Shorter ways ahead are none."""
_ROOM_S = 2.0
_WALL_M, _ABREAST_M = 2.0, 0.5
"""How near a wall ahead ends a corridor, and how far to each side it is looked for: there may be a door in it."""


@dataclass(slots=True)
class FollowCorridor(LooksAhead):
    """Fly on along the corridor that the drone is in, in its middle; through no door."""

    until_s: float = np.inf
    """On the clock of the sights."""
    room: bool = False
    """Whether it ended where the corridor is wider than a corridor."""
    wall: bool = False
    """Whether something solid is close ahead: nothing to follow without it is not the corridor's end."""
    _looks: Looks = field(default_factory=Looks)
    _trail: list[FloatArray] = field(default_factory=list)
    """``(2,)`` places flown through, a metre apart, the newest last."""
    _heading_w: FloatArray | None = None
    """``(2,)`` unit vector of the flight over the last metre; of the drone's nose at first."""
    _began_w: FloatArray | None = None
    """``(2, 2)`` where it began, and the direction of its nose there."""
    _wide_s: float = math.nan
    _target_w: FloatArray | None = None

    def goals(self, layer: Layer, sight: Sight) -> np.ndarray:
        """One cell ``(1, 2)`` to follow, or none."""
        heading = self._followed(sight)
        self._note_width(layer, sight)
        region = _region(layer, sight.p_w[:2])
        self.wall = _blocked(layer, sight.p_w[:2], heading)
        if region is None:
            return self._looks.worth(np.zeros((0, 2), int), layer, sight)
        away = np.asarray(ndimage.distance_transform_edt(~region)) * layer.cell_m
        found = frontiers(layer)
        found = found[away[found[:, 0], found[:, 1]] <= 0.3]
        found = found[self._is_new(layer.centres(found))]
        found = self._looks.worth(np.concatenate([found, self._end(layer, region, sight, heading)]), layer, sight)
        if len(found) == 0:
            return found
        step = layer.centres(found) - sight.p_w[:2]
        far = np.linalg.norm(step, axis=1)
        cost = far + _TURN_COST_M * (1.0 - (step @ heading) / np.maximum(far, 1e-6))
        if self._target_w is not None:  # stays with what it chose
            cost -= 0.5 * (np.linalg.norm(layer.centres(found) - self._target_w, axis=1) < 0.7)
        best = found[int(np.argmin(cost))]
        self._target_w = layer.centres(best)
        return _nearest(region, best)[None]

    def done(self, sight: Sight) -> bool:
        """Whether the corridor ended, or the time."""
        self.room = sight.stamp_s - self._wide_s > _ROOM_S
        return self.room or self._looks.over(sight.stamp_s) or sight.stamp_s >= self.until_s

    def carry(self, moved: Moved) -> None:
        """Take the way flown along with the map; directions of level flight hardly turn with it."""
        self._looks.carry(moved)
        self._trail = list(moved.points(np.array(self._trail).reshape(-1, 2)))
        if self._began_w is not None:
            self._began_w[:1] = moved.points(self._began_w[:1])
        if self._target_w is not None:
            self._target_w = moved.points(self._target_w[None])[0]

    def _followed(self, sight: Sight) -> FloatArray:
        """Note where it is; the direction of the flight ``(2,)``."""
        here = sight.p_w[:2]
        if self._heading_w is None:
            self._heading_w = np.array([math.cos(sight.yaw_rad), math.sin(sight.yaw_rad)])
            self._trail = [here.copy()]
            self._began_w = np.array([here, self._heading_w])
        step = here - self._trail[-1]
        if (length := float(np.linalg.norm(step))) >= _HEADING_M:
            self._heading_w = step / length
            self._trail.append(here.copy())
        return self._heading_w

    def _is_new(self, p_w: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` are neither beside the way flown nor in the corridor behind its start."""
        assert self._began_w is not None
        step = p_w - self._began_w[0]
        behind = (step @ self._began_w[1] < 0.0) & (np.linalg.norm(step, axis=1) < WIDEST_M)
        apart = np.linalg.norm(p_w[:, None] - np.array(self._trail), axis=2).min(axis=1)
        return np.asarray((apart > _PASSED_M) & ~behind)

    def _note_width(self, layer: Layer, sight: Sight) -> None:
        """A room is where nothing solid is within half a corridor's width, and all of that is seen."""
        away = float(layer.clearance_at(sight.p_w[None, :2])[0])
        if 2.0 * away <= WIDEST_M or len(self._trail) < 2:
            self._wide_s = math.nan
        elif math.isnan(self._wide_s):
            self._wide_s = sight.stamp_s

    def _end(self, layer: Layer, region: np.ndarray, sight: Sight, heading: FloatArray) -> np.ndarray:
        """The far end of what is free ahead, ``(1, 2)``; none when the drone is there."""
        cells = np.argwhere(region)
        cells = cells[self._is_new(layer.centres(cells))]
        if len(cells) == 0:
            return cells
        ahead = (layer.centres(cells) - sight.p_w[:2]) @ heading
        best = int(np.argmax(ahead))
        return cells[best : best + 1] if ahead[best] > _ARRIVED_M else cells[:0]


def _region(layer: Layer, here_w: FloatArray) -> np.ndarray | None:
    """The part ``(X, Y)`` of the wide free space that the drone is in or beside; None where there is none."""
    wide = layer.free & (layer.from_solid_m >= _BERTH_M)
    if not wide.any():
        return None
    parts, _ = ndimage.label(wide)
    cell = _nearest(wide, layer.cells(here_w))
    if np.linalg.norm(layer.centres(cell) - here_w) > _LEAST_M:
        return None
    return np.asarray(parts == parts[tuple(cell)])


def _blocked(layer: Layer, here_w: FloatArray, heading: FloatArray) -> bool:
    """Whether something solid is ahead, or to a side of what is ahead."""
    steps = np.arange(0.3, _WALL_M, 0.5 * layer.cell_m)
    left = np.array([-heading[1], heading[0]])
    rays = here_w + steps[:, None, None] * heading + np.array([[-_ABREAST_M], [0.0], [_ABREAST_M]]) * left
    cells = layer.cells(rays)
    return bool(layer.solid[cells[..., 0], cells[..., 1]].any())


def _nearest(mask: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The cell ``(2,)`` of a mask that is nearest to a cell."""
    cells = np.argwhere(mask)
    return np.asarray(cells[int(np.argmin(((cells - cell) ** 2).sum(1)))])
