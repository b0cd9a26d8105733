"""Skill: return to the take-off."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.contact import LOST_M
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.skills.go_to import ARRIVED_M, SLOW_M_S
from edgeslam_torch.navigation.skills.skill import Result, Skill
from edgeslam_torch.types import FloatArray

_LOOK_M, _LOOK_S = 0.6, 3.0
"""Distance from the take-off at which the drone takes its initial heading, and duration of the look: enough for two
keyframes, a loop closure and a view at the new scale. `LOST_M` is the distance after a tracking loss this close, as by
a bare wall behind the take-off."""
_AHEAD_RAD = math.radians(8.0)
_GIVEN_UP_S = 12.0
"""Timeout of turn and look, half a turn at a third of the nominal rate plus the look; and time in which the drone flies
the last metre slowly with that heading, since turning would switch to another part of the map with another drift."""


@dataclass(slots=True)
class ReturnHome(Skill):
    """Fly to the take-off; along the path flown while the take-off lies beyond the grid.

    On the way back the camera faces the opposite direction and revisits nothing, so the map drifts by about 2 % of the
    path. Near the take-off the drone takes its initial heading, so that a loop closure corrects the drift.
    """

    track_w: FloatArray
    """``(N, 2)`` path flown up to the start of the skill, oldest first [m]."""
    _track: Places = field(default_factory=Places)
    """The same as the map has it now, the take-off first."""
    _looked_s: float = math.inf
    """End of the look with the initial heading."""
    _looks_s: float = math.nan
    """Start of that look."""
    _near_s: float = math.nan
    """Start of the turn to it."""
    _look_m: float = _LOOK_M

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cell of the oldest point of the path inside the grid."""
        if len(self._track) == 0:
            self._track.add(state.views, self.track_w, nearest=True)
        points = np.concatenate([np.zeros((1, 2)), self._track.p_w])
        at = (points - layer.corner_w) / layer.cell_m
        inside = ((at >= 1) & (at < np.array(layer.free.shape) - 1)).all(1)
        oldest = points[int(np.argmax(inside))] if inside.any() else state.p_w[:2]
        return layer.cells(oldest)[None]

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """Above the take-off, slow, and the look is over; losses do not end it, since there is no alternative."""
        near, slow = np.linalg.norm(state.p_w[:2]) < ARRIVED_M, np.linalg.norm(state.velocity_w) < SLOW_M_S
        if near and slow and state.stamp_s >= self._looked_s:
            return Result(True, "home")
        return Result(False, "the time is over") if state.stamp_s >= self.until_s else None

    def look_rad(self, state: DroneState) -> float | None:
        """The heading of the take-off, 0, for `_LOOK_S` near the take-off."""
        away = float(np.linalg.norm(state.p_w[:2]))
        if not state.tracked and away < LOST_M:
            self._look_m = LOST_M
        if state.stamp_s >= self._looked_s or away > self._look_m:
            return None
        if math.isnan(self._near_s):
            self._near_s = state.stamp_s
        if math.isnan(self._looks_s) and abs(state.turn_to_rad(0.0)) < _AHEAD_RAD:
            self._looks_s = state.stamp_s
        if state.stamp_s - self._looks_s > _LOOK_S or state.stamp_s - self._near_s > _GIVEN_UP_S:
            self._looked_s = state.stamp_s
        return 0.0

    def faces_rad(self, state: DroneState) -> float | None:
        """The same heading over the last metre."""
        return 0.0 if 0.0 <= state.stamp_s - self._looked_s < _GIVEN_UP_S else None
