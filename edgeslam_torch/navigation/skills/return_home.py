"""Skill: return to the take-off."""

from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.contact import LOST_M
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.skills.go_to import ARRIVED_M, SLOW_M_S
from edgeslam_torch.navigation.skills.skill import Result, Skill
from edgeslam_torch.navigation.views import Look, ViewPlanner
from edgeslam_torch.types import FloatArray

_LOOK_M = 0.6
"""Distance from the take-off at which the drone takes its initial heading; `LOST_M` after a tracking loss this close,
as by a bare wall behind the take-off."""
_LOOK_S = 3.0
"""Duration of the look: two keyframes, a loop closure and a view at the new scale."""


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
    _looked: bool = False
    """Whether it has looked with the initial heading."""
    _look_m: float = _LOOK_M

    def goals(self, layer: Layer, state: DroneState, views: ViewPlanner) -> np.ndarray:
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
        if near and slow and self._looked:
            return Result(True, "home")
        return Result(False, "the time is over") if state.stamp_s >= self.until_s else None

    def looks(self, state: DroneState, views: ViewPlanner) -> bool:
        """Once near the take-off, with its heading."""
        away = float(np.linalg.norm(state.p_w[:2]))
        if not state.tracked and away < LOST_M:
            self._look_m = LOST_M
        if self._looked or away > self._look_m or not state.tracked:
            return False
        self._looked = True
        views.take(Look(0.0, stands_s=_LOOK_S), state)
        return True

    def faces_rad(self, state: DroneState) -> float | None:
        """The same heading over the last metre: turning would switch to another part of the map with another drift."""
        return 0.0 if self._looked and float(np.linalg.norm(state.p_w[:2])) < 2.0 * self._look_m else None
