"""Path along a corridor so far: positions, direction, and dead ends."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.pathways import WIDEST_M
from edgeslam_torch.navigation.openings.wall_frame import Walls, wall_directions
from edgeslam_torch.types import FloatArray

PASSED_M = 0.5 * WIDEST_M
"""Points within this distance of the path flown are in the same corridor."""
_HEADING_M = 1.0
"""Distance over which the direction of flight is measured."""
_ALONG_WALLS_COS = math.cos(math.radians(25.0))
"""Maximum angle between the direction of flight and the walls while avoiding obstacles."""
_DEAD_END_M = 1.5
"""Radius of a dead end."""
SAME_M = 0.3
"""Distance within which places of a corridor are the same."""


@dataclass(slots=True)
class Trail:
    """Path flown along a corridor."""

    _places: Places
    """Positions, a metre apart."""
    began_w: FloatArray
    """``(2,)`` unit vector of the heading at the first position."""
    heading_w: FloatArray
    """``(2,)`` unit vector of the last new metre of flight; initially of the heading."""
    _dead_ends: Places = field(default_factory=Places)
    """Positions with no continuation ahead."""

    @staticmethod
    def beginning(state: DroneState) -> "Trail":
        """A trail that starts at the drone along its heading."""
        nose = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)])
        return Trail(Places(state.views, state.p_w[:2]), nose, nose)

    @property
    def places_w(self) -> FloatArray:
        """``(N, 2)`` path flown, a metre apart."""
        return self._places.p_w

    def fly(self, state: DroneState) -> None:
        """Add the position if it is a metre from all others; backing up adds none."""
        places_w = self.places_w
        steps = state.p_w[:2] - places_w
        away = np.linalg.norm(steps, axis=1)
        last = int(np.argmin(away))
        if away[last] < _HEADING_M:
            return
        shares = np.linspace(0.0, 1.0, int(away[last] / _HEADING_M) + 1)[1:]
        self.heading_w = steps[last] / away[last]
        self._places.add(state.views, places_w[last] + shares[:, None] * steps[last])

    def direction(self, layer: Layer, here_w: FloatArray) -> FloatArray:
        """Unit vector ``(2,)`` of the corridor: of its walls if close to the direction of flight, else the latter."""
        angles = np.array(wall_directions(Walls(layer, layer.solid), here_w))
        along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        cosines = along @ self.heading_w
        best = int(np.argmax(np.abs(cosines))) if len(angles) else -1
        if best < 0 or abs(cosines[best]) < _ALONG_WALLS_COS:
            return self.heading_w
        return np.asarray(along[best] * np.sign(cosines[best]))

    def end(self, state: DroneState) -> None:
        """Mark the position as a dead end."""
        if not self._dead_ends.is_near(state.p_w[:2], SAME_M):
            self._dead_ends.add(state.views, state.p_w[:2])

    def leads_on(self, p_w: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` are in no dead end."""
        return np.asarray(self._dead_ends.away_m(p_w) > _DEAD_END_M)

    def turns_off(self, p_w: FloatArray, here_w: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` lie neither in the corridor flown up to here nor behind its start."""
        step = p_w - self.places_w[0]
        behind = (step @ self.began_w < 0.0) & (np.abs(aside(step, self.began_w)) < PASSED_M)
        flown = np.minimum(self._places.away_m(p_w), np.linalg.norm(p_w - here_w, axis=1)) <= PASSED_M
        return np.asarray(~flown & ~behind)


def aside(step: FloatArray, axis: FloatArray) -> FloatArray:
    """Component of steps ``(..., 2)`` to the left of an axis ``(2,)``.

    Example:
        >>> aside(np.array([3.0, 0.5]), np.array([1.0, 0.0]))
        array(0.5)
    """
    return np.asarray(step[..., 1] * axis[0] - step[..., 0] * axis[1])
