"""Task: follow a corridor around its corners until it ends or opens into a room."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.contact.losses import Losses
from edgeslam_torch.navigation.corridor.corridor_geometry import (
    SMEARED_BERTH_M,
    far_middle,
    is_ahead,
    is_walled,
    mouths,
    straight,
    wide,
)
from edgeslam_torch.navigation.corridor.dead_end_scan import DeadEndScan
from edgeslam_torch.navigation.corridor.trail import PASSED_M, Trail, aside
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import Looks
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.tasks import LooksAhead
from edgeslam_torch.types import FloatArray

_TURN_COST_M = 6.0
"""Cost of a turn by 180 degrees: corridors ahead are preferred to those that turn back."""
_BLIND_M = 1.5
"""Distance of the goal ahead in unknown space."""
_ROOM_S = 2.0
_MOST_LOSSES = 3
"""Tracking losses before a bare wall at a corridor's end after which the scan is aborted."""
_SQUARE_COS = math.cos(math.radians(35.0))
"""A door whose normal is within 35 degrees of the corridor's direction lies across it."""


@dataclass(slots=True)
class FollowCorridor(LooksAhead):
    """Follow the current corridor along its middle, through no known door."""

    until_s: float = np.inf
    """End time on the clock of the states."""
    room: bool = False
    """Whether it ended because the corridor opens into a room."""
    wall: bool = False
    """Whether an obstacle is close ahead; without one, a missing continuation is no end of the corridor."""
    _looks: Looks = field(default_factory=Looks)
    _trail: Trail | None = None
    _end: DeadEndScan | None = None
    """Scan of the last apparent end."""
    _ending: bool = False
    """Whether the corridor appears to end now."""
    _losses: Losses = field(default_factory=lambda: Losses(math.inf))
    """Tracking losses at the apparent end."""
    _wide_s: float = math.nan
    _target: Places = field(default_factory=Places)
    """Current goal in a corridor that turns off."""
    _doors: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    """``(2,)`` centre and unit normal of each exit."""
    _doubtful: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    """The same for candidates, which may also be corridors with a mouth narrowed by depth errors."""

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive doors, which end a corridor."""
        self._doors = [(e.centre_w[:2], e.normal_w[:2]) for e in exits]
        self._doubtful = [(c.centre_w, c.normal_w) for c in candidates]

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Goal cells ``(G, 2)``: wide space ahead, else a corridor that turns off, else narrow space straight ahead,
        else openings in the side walls before the end."""
        here = state.p_w[:2]
        self._trail = self._trail or Trail.beginning(state)
        self._trail.fly(state)
        self._note_width(layer, state)
        axis = self._trail.direction(layer, here)
        self.wall = is_walled(layer, here, axis)
        found = self._looks.worth(self._onward(layer, state, axis, self._trail), layer, state)
        if len(found) or not self._ending or self._end is None:
            return found
        goal = self._end.goal(layer, state)
        return layer.cells(np.zeros((0, 2)) if goal is None else goal[None])

    def heading_rad(self, state: DroneState) -> float | None:
        """Headings of the scan at an apparent end, else ahead."""
        return self._end.heading_rad(state) if self._ending and self._end is not None else None

    def done(self, state: DroneState) -> bool:
        """Whether the corridor ended or the time is over."""
        self.room = state.stamp_s - self._wide_s > _ROOM_S
        return self.room or self._has_ended(state) or state.stamp_s >= self.until_s

    def _has_ended(self, state: DroneState) -> bool:
        if not self._ending or self._end is None:
            return self._looks.over(state.stamp_s)
        self._losses.note(state)
        if self._losses.count >= _MOST_LOSSES:
            self._end.give_up(state)
        return self._end.over

    def _onward(self, layer: Layer, state: DroneState, axis: FloatArray, trail: Trail) -> np.ndarray:
        here = state.p_w[:2]
        cells = self._left(layer, wide(layer, here))
        places = layer.centres(cells)
        if len(ahead := cells[is_ahead(places, here, axis) & trail.leads_on(places)]):
            self._ending = False
            return far_middle(layer, ahead, axis)
        trail.end(state)
        if len(off := cells[trail.turns_off(places, here)]):
            return self._nearest(layer, off, state, axis)
        narrow = straight(layer, here, axis, self._to_door(here, axis))
        if self._ending:  # space between here and the wall leads nowhere
            narrow = narrow[trail.leads_on(layer.centres(narrow))]
        if len(narrow := self._left(layer, far_middle(layer, narrow, axis))):
            return narrow
        if not self.wall and not self._ending:
            return layer.cells(here + _BLIND_M * axis)[None]
        if self._end is None or not (self._ending or self._end.is_near(here)):
            self._end, self._losses = DeadEndScan(Places(state.views, here), axis), Losses(math.inf)
        self._ending = True
        return cells[:0] if self._end.given_up else self._beside(layer, self._end, state, trail)

    def _beside(self, layer: Layer, end: DeadEndScan, state: DroneState, trail: Trail) -> np.ndarray:
        """Before a wall: corridors that turn off through a narrow mouth, else openings in the side walls."""
        here = state.p_w[:2]
        cells = self._left(layer, wide(layer, here, SMEARED_BERTH_M))
        places = layer.centres(cells)
        if len(off := cells[trail.turns_off(places, here) & self._is_this_side(places, here)]):
            return self._nearest(layer, off, state, end.axis)
        return self._left(layer, mouths(layer, end.end_w, end.axis, trail.places_w))

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
            if abs(float(normal @ axis)) > _SQUARE_COS and abs(float(aside(middle - here, axis))) < PASSED_M
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
