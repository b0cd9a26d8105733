"""Skill: follow a corridor around its corners until it ends or opens into a room."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import SAME_COS, Exit
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.openings.wall_frame import Walls, wall_directions
from edgeslam_torch.navigation.skills.skill import FEW_LOSSES, Result, Skill, since_s
from edgeslam_torch.navigation.views import Look, ViewPlanner
from edgeslam_torch.types import FloatArray

_BERTH_M, _NARROW_M = 0.45, 0.3
"""Clearance of the space that is followed: a corridor is wider than twice this, a doorway is not; and straight ahead,
where underestimated depth may narrow the corridor to a door's width."""
_ARRIVED_M = 0.6
"""Minimum free distance ahead."""
_SAME_CORRIDOR_M = 0.5 * WIDEST_M
"""Points within this distance of the path flown are in the same corridor."""
_STEP_M = 1.0
"""Distance over which the direction of flight is measured, and to the free space that is followed."""
_ALONG_WALLS_COS = math.cos(math.radians(25.0))
"""Maximum angle between the direction of flight and the walls while avoiding obstacles."""
_DEAD_END_M = 1.5
"""Radius of a dead end, and distance of the goal ahead in unknown space."""
_WALL_M = 2.0
"""Distance at which a wall ahead ends a corridor."""
_SWEEP_M = (1.0, 2.5)
"""Distances before an apparent end from which its sides are viewed: a corridor that turns off there was seen at a
grazing angle in passing, and depth may have closed its mouth."""
_AT_END_M = 0.4
_TURN_COST_M = 6.0
"""Cost of a turn by 180 degrees: corridors ahead are preferred to those that turn back."""
ENDS = Result(True, "the corridor ends")
_HOLDS_S = 2.0
"""Time for which a room, or an end without a view that is left, must hold: views arrive half a second late, and two
free a cell."""


@dataclass(slots=True)
class FollowCorridor(Skill):
    """Follow the current corridor along its middle, through no known door."""

    _trail: Places = field(default_factory=Places)
    """Path flown, a metre apart."""
    _began_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    """``(2,)`` unit vector of the heading at its first position."""
    _heading_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    """``(2,)`` unit vector of the last new metre of flight; initially of the heading."""
    _dead_ends: Places = field(default_factory=Places)
    """Positions with no continuation ahead."""
    _end: Places = field(default_factory=Places)
    """Apparent end of the corridor, if it appears to end now."""
    _viewed_s: float = math.nan
    """Since when no view of the apparent end's sides is left, and the drone is back there."""
    _sweep: Places = field(default_factory=Places)
    """Places from which to view them, the next one first."""
    _swept: Places = field(default_factory=Places)
    """Places from which sides were viewed."""
    _sides_rad: list[float] = field(default_factory=list)
    """Bearings of the sides to view from here."""
    _wide_s: float = math.nan
    """Since when it is in a room."""
    _doors: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    """``(2,)`` centre and unit normal of each exit."""

    def consider(self, exits: Sequence[Exit]) -> None:
        """Receive doors, which end a corridor."""
        self._doors = [(e.centre_w[:2], e.normal_w[:2]) for e in exits]

    def goals(self, layer: Layer, state: DroneState, views: ViewPlanner) -> np.ndarray:
        """Goal cells ``(G, 2)``: wide space ahead, else a corridor that turns off, else narrow or unknown space
        straight ahead, else where to view the sides before the end, else the end."""
        here = state.p_w[:2]
        self._fly(state)
        room = len(self._trail) > 1 and 2.0 * float(layer.clearance_at(here[None])[0]) > WIDEST_M
        self._wide_s = since_s(room, self._wide_s, state)
        axis = self._direction(layer, here)
        found = self._onward(layer, state, axis)
        if len(found):
            self._viewed_s, self._sides_rad = math.nan, []
            return found
        if self._sweep.is_near(here, _AT_END_M):
            ahead = math.atan2(axis[1], axis[0])
            self._sides_rad = [ahead + 0.5 * math.pi, ahead - 0.5 * math.pi]
            self._swept.add(state.views, here)
        self._sweep.keep(self._swept.away_m(self._sweep.p_w) > _STEP_M)
        self._viewed_s = since_s(not len(self._sweep) and self._end.is_near(here, _AT_END_M), self._viewed_s, state)
        return layer.cells(self._sweep.p_w[:1] if len(self._sweep) else self._end.p_w)

    def looks(self, state: DroneState, views: ViewPlanner) -> bool:
        """To the sides before an apparent end."""
        if not self._sides_rad or not state.tracked:
            return False
        views.take(Look(self._sides_rad.pop()), state)
        return True

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """The corridor ended, or the drone has not flown a metre of one."""
        ends = state.stamp_s - self._viewed_s > _HOLDS_S or (len(self._end) > 0 and losses >= FEW_LOSSES)
        room = state.stamp_s - self._wide_s > _HOLDS_S
        result = super(FollowCorridor, self).result(state, losses)
        if (room or ends or result is not None) and len(self._trail) < 2:
            return Result(False, "there is no corridor here")
        if room:
            return Result(True, "the corridor opens into a room")
        return ENDS if ends else result

    def no_way(self) -> Result:
        """An apparent end is one also if the way back from it is not seen."""
        return ENDS if len(self._end) and len(self._trail) > 1 else super(FollowCorridor, self).no_way()

    def _fly(self, state: DroneState) -> None:
        """Add the position to the trail if it is a metre from all others; backing up adds none."""
        here = state.p_w[:2]
        if not len(self._trail):
            self._trail.add(state.views, here)
            self._began_w = self._heading_w = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        trail_w = self._trail.p_w
        away = np.linalg.norm(here - trail_w, axis=1)
        last = int(np.argmin(away))
        if away[last] >= _STEP_M:
            shares = np.linspace(0.0, 1.0, int(away[last] / _STEP_M) + 1)[1:]
            self._heading_w = (here - trail_w[last]) / away[last]
            self._trail.add(state.views, trail_w[last] + shares[:, None] * (here - trail_w[last]))

    def _direction(self, layer: Layer, here: FloatArray) -> FloatArray:
        """Unit vector ``(2,)`` of the corridor: of its walls if close to the direction of flight, else the latter."""
        angles = np.array(wall_directions(Walls(layer, layer.solid), here))
        along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        cosines = along @ self._heading_w
        best = int(np.argmax(np.abs(cosines))) if len(angles) else -1
        if best < 0 or abs(cosines[best]) < _ALONG_WALLS_COS:
            return self._heading_w
        return np.asarray(along[best] * np.sign(cosines[best]))

    def _onward(self, layer: Layer, state: DroneState, axis: FloatArray) -> np.ndarray:
        """Where the corridor leads on ``(G, 2)``; sets or resets its end."""
        here = state.p_w[:2]
        cells = _wide(layer, here, _BERTH_M)
        p_w = layer.centres(cells).reshape(-1, 2)
        along = (p_w - here) @ axis
        ahead = (along > _ARRIVED_M) & (along > SAME_COS * np.linalg.norm(p_w - here, axis=1)) & self._leads_on(p_w)
        if ahead.any():
            self._end = Places()
            return _far_middle(layer, cells[ahead], axis)
        if not self._dead_ends.is_near(here, _AT_END_M):
            self._dead_ends.add(state.views, here)
        off = self._turns_off(p_w, here)
        if off.any():
            far = np.linalg.norm(p_w[off] - here, axis=1)
            cost = far + _TURN_COST_M * (1.0 - along[off] / np.maximum(far, 1e-6))
            return np.asarray(cells[off][[int(np.argmin(cost))]])
        cells = _wide(layer, here, _NARROW_M, (axis, _ARRIVED_M))
        p_w = layer.centres(cells).reshape(-1, 2)
        along = (p_w - here) @ axis
        straight = (along > _ARRIVED_M) & (along < self._to_door(here, axis))
        if len(self._end):  # space between here and the wall leads nowhere
            straight &= self._leads_on(p_w)
        if straight.any():
            return _far_middle(layer, cells[straight], axis)
        if not len(self._end) and not _is_walled(layer, here, axis):
            return layer.cells(here + _DEAD_END_M * axis)[None]
        if not len(self._end):
            self._end = Places(state.views, here)
            self._sweep = Places(state.views, here - np.array(_SWEEP_M)[:, None] * axis)
        return cells[:0]

    def _leads_on(self, p_w: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` are in no dead end."""
        return np.asarray(self._dead_ends.away_m(p_w) > _DEAD_END_M)

    def _turns_off(self, p_w: FloatArray, here: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` lie neither in the corridor flown up to here nor behind its start."""
        step = p_w - self._trail.p_w[0]
        behind = (step @ self._began_w < 0.0) & (np.abs(aside(step, self._began_w)) < _SAME_CORRIDOR_M)
        flown = np.minimum(self._trail.away_m(p_w), np.linalg.norm(p_w - here, axis=1)) <= _SAME_CORRIDOR_M
        return np.asarray(~flown & ~behind)

    def _to_door(self, here: FloatArray, axis: FloatArray) -> float:
        """Distance straight ahead to the first door across the corridor [m]; infinite without one."""
        ways = [
            float((middle - here) @ axis)
            for middle, normal in self._doors
            if abs(float(normal @ axis)) > SAME_COS and abs(float(aside(middle - here, axis))) < _SAME_CORRIDOR_M
        ]
        return min([way for way in ways if way > 0.0], default=math.inf)


def aside(step: FloatArray, axis: FloatArray) -> FloatArray:
    """Component of steps ``(..., 2)`` to the left of an axis ``(2,)``.

    Example:
        >>> aside(np.array([3.0, 0.5]), np.array([1.0, 0.0]))
        array(0.5)
    """
    return np.asarray(step[..., 1] * axis[0] - step[..., 0] * axis[1])


def _wide(layer: Layer, here: FloatArray, berth_m: float, strip: tuple[FloatArray, float] | None = None) -> np.ndarray:
    """Cells ``(N, 2)`` of the connected free space with this clearance around the drone, perhaps only those in a strip:
    its axis ``(2,)`` and half width."""
    open_ = layer.free & (layer.from_solid_m >= berth_m)
    if strip is not None:
        centres = layer.centres(np.moveaxis(np.indices(open_.shape), 0, -1))
        open_ &= np.abs(aside(centres - here, strip[0])) < strip[1]
    cells = np.argwhere(open_)
    away = np.linalg.norm(layer.centres(cells).reshape(-1, 2) - here, axis=1)
    if away.min(initial=math.inf) > _STEP_M:
        return cells[:0]
    return np.argwhere(layer.part_around(open_, layer.centres(cells[int(np.argmin(away))])))


def _far_middle(layer: Layer, cells: np.ndarray, axis: FloatArray) -> np.ndarray:
    """Middle one ``(1, 2)`` of the cells ``(N, 2)`` that lie farthest along an axis."""
    along = layer.centres(cells) @ axis
    last = cells[along > along.max() - 3.0 * layer.cell_m]
    left = aside(layer.centres(last), axis)
    return np.asarray(last[[int(np.argmin(np.abs(left - np.median(left))))]])


def _is_walled(layer: Layer, here: FloatArray, axis: FloatArray) -> bool:
    """Whether an obstacle is close ahead, within half a door's width to each side."""
    steps = np.arange(0.3, _WALL_M, 0.5 * layer.cell_m)
    left = np.array([-axis[1], axis[0]])
    rays = here + steps[:, None, None] * axis + np.array([[-0.5], [0.0], [0.5]]) * left
    cells = layer.cells(rays)
    return bool(layer.solid[cells[..., 0], cells[..., 1]].any())
