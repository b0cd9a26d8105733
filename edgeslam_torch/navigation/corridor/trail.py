"""The way along a corridor so far: its places, its direction, and where it did not lead on."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.openings.wall_frame import Walls, wall_directions
from edgeslam_torch.types import FloatArray

PASSED_M = 0.5 * WIDEST_M
"""What is within this of the way that was flown is the same corridor."""
_HEADING_M = 1.0
"""Way over which the direction of flight is taken."""
_ALONG_WALLS_COS = math.cos(math.radians(25.0))
"""A drone that keeps clear of things on one side flies aslant to the walls by no more than this."""
_DEAD_END_M = 1.5
"""What is within this of where there was no way ahead is no way ahead from elsewhere."""
_SAME_M = 0.3


@dataclass(slots=True)
class Trail:
    """Where a drone has followed a corridor."""

    places_w: FloatArray
    """``(N, 2)`` on the way flown, a metre apart."""
    began_w: FloatArray
    """``(2,)`` unit vector of its nose at the first of them."""
    heading_w: FloatArray
    """``(2,)`` unit vector of the flight over its last new metre; of the nose at first."""
    _dead_ends_w: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """``(D, 2)`` places from which nothing led on ahead."""

    @staticmethod
    def beginning(state: DroneState) -> "Trail":
        """At the drone's place, along its nose."""
        nose = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        return Trail(state.p_w[None, :2].copy(), nose, nose)

    def fly(self, here_w: FloatArray) -> None:
        """Note a place ``(2,)`` that is a metre from all before it: a drone that is brought back still flies ahead."""
        steps = here_w - self.places_w
        away = np.linalg.norm(steps, axis=1)
        last = int(np.argmin(away))
        if away[last] < _HEADING_M:
            return
        shares = np.linspace(0.0, 1.0, int(away[last] / _HEADING_M) + 1)[1:]
        self.heading_w = steps[last] / away[last]
        self.places_w = np.concatenate([self.places_w, self.places_w[last] + shares[:, None] * steps[last]])

    def direction(self, layer: Layer, here_w: FloatArray) -> FloatArray:
        """Unit vector ``(2,)`` of the corridor: of its walls, where they lead where the drone flies."""
        angles = np.array(wall_directions(Walls(layer, layer.solid), here_w))
        along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        cosines = along @ self.heading_w
        best = int(np.argmax(np.abs(cosines))) if len(angles) else -1
        if best < 0 or abs(cosines[best]) < _ALONG_WALLS_COS:
            return self.heading_w
        return np.asarray(along[best] * np.sign(cosines[best]))

    def end(self, here_w: FloatArray) -> None:
        """From here ``(2,)`` nothing leads on ahead."""
        if _apart(here_w[None], self._dead_ends_w, _SAME_M)[0]:
            self._dead_ends_w = np.concatenate([self._dead_ends_w, here_w[None]])

    def leads_on(self, p_w: FloatArray) -> np.ndarray:
        """Which of the places ``(N, 2)`` ahead are in no dead end."""
        return _apart(p_w, self._dead_ends_w, _DEAD_END_M)

    def turns_off(self, p_w: FloatArray, here_w: FloatArray) -> np.ndarray:
        """Which of the places ``(N, 2)`` are not in the corridor that was flown up to here, nor behind its start."""
        step = p_w - self.places_w[0]
        behind = (step @ self.began_w < 0.0) & (np.abs(aside(step, self.began_w)) < PASSED_M)
        return _apart(p_w, np.concatenate([self.places_w, here_w[None]]), PASSED_M) & ~behind

    def carry(self, update: MapUpdate) -> None:
        """Take the places along with the map; directions of level flight hardly turn with it."""
        self.places_w = update.points(self.places_w)
        self._dead_ends_w = update.points(self._dead_ends_w)


def aside(step: FloatArray, axis: FloatArray) -> FloatArray:
    """How far to the left of an axis ``(2,)`` steps ``(..., 2)`` lead.

    Example:
        >>> aside(np.array([3.0, 0.5]), np.array([1.0, 0.0]))
        array(0.5)
    """
    return np.asarray(step[..., 1] * axis[0] - step[..., 0] * axis[1])


def _apart(p_w: FloatArray, places_w: FloatArray, away_m: float) -> np.ndarray:
    """Which of the points ``(N, 2)`` are so far from all of the places ``(M, 2)``."""
    return np.asarray((np.linalg.norm(p_w[:, None] - places_w, axis=2) > away_m).all(axis=1))
