"""A look to the sides of a corridor that seems to end: what turns off before a dead end is hardly seen in passing."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.corridor.corridor_geometry import unknown_sides
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.types import FloatArray

_BACK_M = 2.2
"""Way back from the end to where it looks: the middle of what a turn at the end shows aslant."""
_THERE_M = 0.3
_THERE_RAD = math.radians(5.0)
_STANDS_S = 1.0
"""Time of a look: five views."""
_TURN_S = 12.5
"""Time of a turn on the spot, 30 degrees a second: what turns off right there is seen by that."""
_GIVEN_UP_S = 20.0
"""Time for a way of metres: one that does not come there looks from where it is."""
_SAME_END_M = 1.5
"""Ends that are nearer to each other are one: what is known ahead changes while it looks to the sides."""
_ABOUT_M = 1.0
"""How near the end it may stay when it gives up: before a bare wall the pose is lost again."""


@dataclass(slots=True)
class DeadEndScan:
    """A turn on the spot at the end, a look back from it to each side that is not known to be a wall, and to the end
    again."""

    end_w: FloatArray
    """``(2,)`` where the corridor seems to end."""
    axis: FloatArray
    """``(2,)`` unit vector of its direction there."""
    over: bool = False
    """Whether it has looked, and is back at the end."""
    given_up: bool = False
    """Whether nothing is looked at any more."""
    _headings: list[float] | None = None
    """Still to be looked at, last first; None before it was there."""
    _reached_s: float = math.nan
    """Since when it looks at the last of these."""
    _leg_s: float = math.nan
    """Since when it flies to where it does the next of these things."""
    _turns_s: float = math.nan
    """Since when it turns at the end."""

    def goal(self, layer: Layer, state: DroneState) -> FloatArray | None:
        """Where to fly ``(2,)``; None when nothing is left to do, and for a turn on the spot."""
        self._leg_s = state.stamp_s if math.isnan(self._leg_s) else self._leg_s
        late = state.stamp_s - self._leg_s > _GIVEN_UP_S
        if math.isnan(self._turns_s):
            if not late and _away(state, self.end_w) > _THERE_M:
                return self.end_w
            self._turns_s = self._leg_s = state.stamp_s
        if state.stamp_s - self._turns_s < _TURN_S:
            self._leg_s = state.stamp_s
            return None
        if self._headings is None:
            place = self.end_w - _BACK_M * self.axis
            sides = unknown_sides(layer, self.end_w, self.axis)
            if sides and not late and _away(state, place) > _THERE_M:
                return place
            self._headings = [] if late else [math.atan2(side[1], side[0]) for side in sides]
            self._leg_s = state.stamp_s
            late = False
        self.over = late or _away(state, self.end_w) < (_ABOUT_M if self.given_up else _THERE_M)
        return None if self.over else self.end_w

    def is_near(self, here_w: FloatArray) -> bool:
        """Whether a corridor that seems to end here ``(2,)`` seems to end there."""
        return float(np.linalg.norm(here_w - self.end_w)) < _SAME_END_M

    def give_up(self, state: DroneState) -> None:
        """Look at nothing more: back to the end, unless it is about there."""
        if not self.given_up:
            self.given_up, self._headings = True, []
            self._turns_s, self._leg_s = -math.inf, state.stamp_s
        self.over |= _away(state, self.end_w) < _ABOUT_M

    def heading_rad(self, state: DroneState) -> float | None:
        """Where to look now, standing; a pose that is lost ends it."""
        if not self._headings:
            return None
        if not state.tracked:
            self._headings = []
            return None
        if abs(float(wrapped(np.array(self._headings[-1] - state.yaw_rad)))) > _THERE_RAD:
            self._reached_s = state.stamp_s
        elif state.stamp_s - self._reached_s > _STANDS_S:
            self._headings.pop()
            self._reached_s = state.stamp_s
        return self._headings[-1] if self._headings else None

    def carry(self, update: MapUpdate) -> None:
        """Take the end along with the map."""
        self.end_w = update.points(self.end_w[None])[0]


def _away(state: DroneState, place_w: FloatArray) -> float:
    """Distance of the drone to a place ``(2,)``."""
    return float(np.linalg.norm(state.p_w[:2] - place_w))
