"""Skill: follow a corridor around its corners until it ends or opens into a room."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.corridor.corridor_geometry import (
    SMEARED_BERTH_M,
    far_middle,
    is_ahead,
    is_walled,
    straight,
    wide,
)
from edgeslam_torch.navigation.corridor.trail import PASSED_M, Trail, aside
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import Looks
from edgeslam_torch.navigation.exploring.view_planner import ViewPlanner
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import SAME_COS, Candidate, Exit
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.skills.skill import FEW_LOSSES, Result, Skill
from edgeslam_torch.types import FloatArray

_TURN_COST_M = 6.0
"""Cost of a turn by 180 degrees: corridors ahead are preferred to those that turn back."""
_BLIND_M = 1.5
"""Distance of the goal ahead in unknown space."""
_BACK_M = 2.3
"""Distance from an apparent end from within which its sides are viewed: a corridor that turns off there was seen at
a grazing angle in passing."""
_AT_END_M = 0.4
_STANDS_S = 1.0
"""Duration of a view at each heading: five depth maps, which show an entrance that was seen at a grazing angle."""
_HOLDS_S = 2.0
"""Time for which a room, or an end without a view that is left, must hold: views arrive half a second late, and two
free a cell."""


@dataclass(slots=True)
class FollowCorridor(Skill):
    """Follow the current corridor along its middle, through no known door."""

    wall: bool = False
    """Whether an obstacle is close ahead; without one, a missing continuation is no end of the corridor."""
    _looks: Looks = field(default_factory=Looks)
    _views: ViewPlanner = field(default_factory=lambda: ViewPlanner(_STANDS_S))
    _trail: Trail | None = None
    _end: Places = field(default_factory=Places)
    """Apparent end of the corridor, if it appears to end now."""
    _viewed_s: float = math.nan
    """Since when no view of the apparent end is left, and the drone is back there."""
    _wide_s: float = math.nan
    _target: Places = field(default_factory=Places)
    """Current goal in a corridor that turns off."""
    _doors: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    """``(2,)`` centre and unit normal of each exit."""
    _doubtful: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    """The same for candidates, which may also be corridors with an entrance narrowed by depth errors."""

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive doors, which end a corridor."""
        self._doors = [(e.centre_w[:2], e.normal_w[:2]) for e in exits]
        self._doubtful = [(c.centre_w, c.normal_w) for c in candidates]

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Goal cells ``(G, 2)``: wide space ahead, else a corridor that turns off, else narrow space straight ahead,
        else a side corridor through a narrowed entrance, else viewpoints of the sides before the end."""
        here = state.p_w[:2]
        self._trail = self._trail or Trail.beginning(state)
        self._trail.fly(state)
        self._note_width(layer, state)
        axis = self._trail.direction(layer, here)
        self.wall = is_walled(layer, here, axis)
        found = self._looks.worth(self._onward(layer, state, axis, self._trail), layer, state)
        if len(found) or not len(self._end):
            self._viewed_s = math.nan
            return found
        cells = wide(layer, here)
        cells = cells[self._end.away_m(layer.centres(cells).reshape(-1, 2)) < _BACK_M]
        spots = self._views.goals(layer, state, found, cells)
        at_end = self._end.is_near(here, _AT_END_M)
        if len(spots) or self._views.looks_from(here) or not at_end:
            self._viewed_s = math.nan
        elif math.isnan(self._viewed_s):
            self._viewed_s = state.stamp_s
        return spots if len(spots) or at_end else layer.cells(self._end.p_w)

    def look_rad(self, state: DroneState) -> float | None:
        """Headings of the view planner at an apparent end, else ahead."""
        return self._views.heading_rad(state) if len(self._end) else None

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """The corridor ended, or the drone has not flown a metre of one."""
        viewed = state.stamp_s - self._viewed_s > _HOLDS_S
        ends = viewed or losses >= FEW_LOSSES if len(self._end) else self._looks.over(state.stamp_s)
        room = state.stamp_s - self._wide_s > _HOLDS_S
        result = super(FollowCorridor, self).result(state, losses)
        if not (room or ends or result is not None):
            return None
        if self._trail is None or len(self._trail.places_w) < 2:
            return Result(False, "there is no corridor here")
        if room:
            return Result(True, "the corridor opens into a room")
        if ends:
            ended = Result(True, "the corridor ends")
            return ended if len(self._end) else Result(False, "neither a continuation nor an end is visible")
        return result

    def _onward(self, layer: Layer, state: DroneState, axis: FloatArray, trail: Trail) -> np.ndarray:
        here = state.p_w[:2]
        cells = self._left(layer, wide(layer, here))
        places = layer.centres(cells)
        if len(ahead := cells[is_ahead(places, here, axis) & trail.leads_on(places)]):
            self._end = Places()
            return far_middle(layer, ahead, axis)
        trail.end(state)
        if len(off := cells[trail.turns_off(places, here)]):
            return self._nearest(layer, off, state, axis)
        narrow = straight(layer, here, axis, self._to_door(here, axis))
        if len(self._end):  # space between here and the wall leads nowhere
            narrow = narrow[trail.leads_on(layer.centres(narrow))]
        if len(narrow := self._left(layer, far_middle(layer, narrow, axis))):
            return narrow
        if not self.wall and not len(self._end):
            return layer.cells(here + _BLIND_M * axis)[None]
        if not len(self._end):
            self._end = Places(state.views, here)
        cells = self._left(layer, wide(layer, here, SMEARED_BERTH_M))
        places = layer.centres(cells)
        off = cells[trail.turns_off(places, here) & self._is_this_side(places, here)]
        return self._nearest(layer, off, state, axis) if len(off) else off

    def _left(self, layer: Layer, cells: np.ndarray) -> np.ndarray:
        """Cells ``(N, 2)`` that were not inspected without success."""
        return cells[self._looks.left(layer.centres(cells))]

    def _nearest(self, layer: Layer, cells: np.ndarray, state: DroneState, axis: FloatArray) -> np.ndarray:
        """Nearest cell ``(1, 2)`` of corridors that turn off, with hysteresis."""
        places = layer.centres(cells)
        step = places - state.p_w[:2]
        far = np.linalg.norm(step, axis=1)
        cost = far + _TURN_COST_M * (1.0 - (step @ axis) / np.maximum(far, 1e-6))
        if len(self._target):
            cost -= 0.5 * (np.linalg.norm(places - self._target.last_w, axis=1) < 0.7)
        best = int(np.argmin(cost))
        self._target = Places(state.views, places[best])
        return cells[[best]]

    def _is_this_side(self, p_w: FloatArray, here: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` are not behind a door, taken as wide as the widest corridor."""
        good = np.ones(len(p_w), dtype=bool)
        for middle, normal in self._doors:
            behind = ((p_w - middle) @ normal) * float((here - middle) @ normal) < 0.0
            good &= ~(behind & (np.abs(aside(p_w - middle, normal)) < PASSED_M))
        return good

    def _to_door(self, here: FloatArray, axis: FloatArray) -> float:
        """Distance straight ahead to the first door across the corridor [m]; infinite without one."""
        ways = [
            float((middle - here) @ axis)
            for middle, normal in (*self._doors, *self._doubtful)
            if abs(float(normal @ axis)) > SAME_COS and abs(float(aside(middle - here, axis))) < PASSED_M
        ]
        return min([way for way in ways if way > 0.0], default=math.inf)

    def _note_width(self, layer: Layer, state: DroneState) -> None:
        """Detect a room: all space within half a corridor's width is known to be free."""
        assert self._trail is not None
        away = float(layer.clearance_at(state.p_w[None, :2])[0])
        if 2.0 * away <= WIDEST_M or len(self._trail.places_w) < 2:
            self._wide_s = math.nan
        elif math.isnan(self._wide_s):
            self._wide_s = state.stamp_s
