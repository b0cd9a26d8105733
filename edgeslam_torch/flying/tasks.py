"""Tasks that a flight has beside those of `navigation.tasks`: to stay where it is, and to go back the way it came."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit
from edgeslam_torch.navigation.tasks import LooksAhead
from edgeslam_torch.types import FloatArray

HOME_M = 0.15
"""Distance from the take-off at which the drone is home."""
_SLOW_M_S = 0.15
_LOOK_M, _LOOK_S = 0.6, 3.0
"""How near to the take-off it looks ahead, and for how long: two keyframes, a loop, and a view in new metres."""
_LOST_M = 1.5
"""The same once its pose was lost this near: a bare wall behind the take-off shows nothing to come home by."""
_AHEAD_RAD = math.radians(8.0)
_GIVEN_UP_S = 12.0
"""Time to turn and look: half a turn at a third of the usual rate, and the look. A drone may not be able to turn."""
_FACES_S = 12.0
"""Time in which it flies the last metre as it looks, slowly: what a turn would show is another part of the map, of a
single turn before, and was seen to lie a quarter of a metre elsewhere."""


@dataclass(frozen=True, slots=True)
class Stay(LooksAhead):
    """Rise, look around, and hover."""

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Where it is."""
        return layer.cells(state.p_w[:2])[None]

    def done(self, state: DroneState) -> bool:
        """At once: a pilot asks only when it is at its height."""
        return True

    def carry(self, update: MapUpdate) -> None:
        """It remembers nothing."""


@dataclass(slots=True)
class WayHome:
    """Fly to the take-off, along the way that was flown as long as the take-off lies beyond the grid.

    On the way back a camera sees the back of all that it saw on the way there, so that the map drifts by two percent
    of the way. Near the take-off it looks ahead as it did there, and the map is mended by what it knows again.
    """

    track_w: FloatArray
    """``(N, 2)`` where it flew, oldest first [m]."""
    _looked_s: float = math.inf
    """When it had looked as at its take-off."""
    _looks_s: float = math.nan
    """Since when it looks where it looked at its take-off."""
    _near_s: float = math.nan
    """Since when it wants to."""
    _look_m: float = _LOOK_M

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """The cell of the oldest point of the way that the grid still holds."""
        points = np.concatenate([np.zeros((1, 2)), self.track_w])
        at = (points - layer.corner_w) / layer.cell_m
        held = ((at >= 1) & (at < np.array(layer.free.shape) - 1)).all(1)
        oldest = points[int(np.argmax(held))] if held.any() else state.p_w[:2]
        return layer.cells(oldest)[None]

    def done(self, state: DroneState) -> bool:
        """Whether the drone is above its take-off, slow, and has looked as it did there."""
        near = float(np.linalg.norm(state.p_w[:2])) < HOME_M
        return state.stamp_s >= self._looked_s and near and float(np.linalg.norm(state.velocity_w)) < _SLOW_M_S

    def gives_up(self, losses: int) -> bool:
        """No: there is nothing else to fly for."""
        return False

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """It passes every opening by."""

    def heading_rad(self, state: DroneState) -> float | None:
        """The heading of the take-off, which is 0, for seconds when it comes near."""
        away = float(np.linalg.norm(state.p_w[:2]))
        if not state.tracked and away < _LOST_M:
            self._look_m = _LOST_M
        if state.stamp_s >= self._looked_s or away > self._look_m:
            return None
        if math.isnan(self._near_s):
            self._near_s = state.stamp_s
        if math.isnan(self._looks_s) and abs(float(wrapped(np.array(state.yaw_rad)))) < _AHEAD_RAD:
            self._looks_s = state.stamp_s
        if state.stamp_s - self._looks_s > _LOOK_S or state.stamp_s - self._near_s > _GIVEN_UP_S:
            self._looked_s = state.stamp_s
        return 0.0

    def faces_rad(self, state: DroneState) -> float | None:
        """The same heading for the last metre."""
        return 0.0 if 0.0 <= state.stamp_s - self._looked_s < _FACES_S else None

    def carry(self, update: MapUpdate) -> None:
        """Take the way along with the map; the take-off stays the origin."""
        self.track_w = update.points(self.track_w)
