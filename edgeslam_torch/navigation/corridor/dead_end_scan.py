"""Scan of the sides at an apparent dead end: a corridor that turns off is hardly visible in passing."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.corridor.corridor_geometry import unknown_sides
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.types import FloatArray

_BACK_M = 2.2
"""Distance back from the end to the viewpoint: the middle of what a turn at the end sees at a grazing angle."""
_THERE_M = 0.3
_THERE_RAD = math.radians(5.0)
_STANDS_S = 1.0
"""Duration of a look: five views."""
_TURN_S = 12.5
"""Duration of a full turn at 30 deg/s, which shows corridors that turn off right at the end."""
_GIVEN_UP_S = 20.0
"""Timeout of a leg; the drone then looks from where it is."""
_SAME_END_M = 1.5
"""Ends closer than this are the same; the map ahead changes during the scan."""
_ABOUT_M = 1.0
"""Distance from the end that suffices after giving up: tracking is lost again before a bare wall."""


@dataclass(slots=True)
class DeadEndScan:
    """A full turn at the end, a look to each side without a known wall from farther back, and the return to the end."""

    end: Places
    """Apparent end of the corridor, one point."""
    axis: FloatArray
    """``(2,)`` unit vector of its direction there."""
    over: bool = False
    """Whether the scan is complete and the drone is back at the end."""
    given_up: bool = False
    """Whether the scan was aborted."""
    _headings: list[float] | None = None
    """Remaining headings, last first; None before the viewpoint is reached."""
    _reached_s: float = math.nan
    """Since when the drone faces the last of them."""
    _leg_s: float = math.nan
    """Start of the current leg."""
    _turns_s: float = math.nan
    """Start of the full turn."""

    @property
    def end_w(self) -> FloatArray:
        """``(2,)`` where the end is now."""
        return self.end.last_w

    def goal(self, layer: Layer, state: DroneState) -> FloatArray | None:
        """Goal ``(2,)``; None during the full turn and when the scan is over."""
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
        """Whether an apparent end at ``(2,)`` is the same as this one."""
        return float(np.linalg.norm(here_w - self.end_w)) < _SAME_END_M

    def give_up(self, state: DroneState) -> None:
        """Abort the scan and return to the end, unless close to it."""
        if not self.given_up:
            self.given_up, self._headings = True, []
            self._turns_s, self._leg_s = -math.inf, state.stamp_s
        self.over |= _away(state, self.end_w) < _ABOUT_M

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to turn to while hovering; a tracking loss ends the looks."""
        if not self._headings:
            return None
        if not state.tracked:
            self._headings = []
            return None
        if abs(state.turn_to_rad(self._headings[-1])) > _THERE_RAD:
            self._reached_s = state.stamp_s
        elif state.stamp_s - self._reached_s > _STANDS_S:
            self._headings.pop()
            self._reached_s = state.stamp_s
        return self._headings[-1] if self._headings else None


def _away(state: DroneState, place_w: FloatArray) -> float:
    """Distance of the drone from a point ``(2,)``."""
    return float(np.linalg.norm(state.p_w[:2] - place_w))
