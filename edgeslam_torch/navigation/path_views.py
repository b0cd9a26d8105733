"""Next best view for the path: from where the drone stands, turned or from above, by the unknown cells that it shows.

The camera is tilted down and does not see the space at its own height close ahead; from above it does.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import PLACES_M
from edgeslam_torch.types import FloatArray

_RISE_M = 0.25
"""From here above the flight height a Tello's camera sees that height from 0.6 m on."""
_HEADINGS = 24
_THERE_RAD, _THERE_M = math.radians(8.0), 0.06
"""Errors of heading and height with which a view is taken."""
_STANDS_S = 0.6
"""Duration of a view: three depth maps at 5 Hz, of which two free a cell."""
_TIMEOUT_S = 6.0
"""Half a turn and a rise, and half as much again."""


@dataclass(frozen=True, slots=True)
class Look:
    """A view to be taken from here."""

    heading_rad: float
    rise_m: float
    """Above the flight height."""


@dataclass(slots=True)
class PathViews:
    """Chooses and takes views of a path until no view would show more of it."""

    half_m: float
    """Half the height of the space that the drone needs."""
    look: Look | None = None
    """The view that is being taken."""
    exhausted: Places = field(default_factory=Places)
    """The last place from which no view shows more."""
    _place: Places = field(default_factory=Places)
    _taken: list[Look] = field(default_factory=list)
    """Views taken there."""
    _since_s: float = math.nan
    """Start of the view that is being taken."""
    _stands_s: float = math.nan
    """Since when the drone has had this position and heading."""

    def begin(
        self, unseen_w: FloatArray, ahead_rad: float, view: View | None, state: DroneState, limits: NavLimits
    ) -> bool:
        """Begin the view that shows most unknown cells ``(U, 2)`` of the path a second; False if none shows any.

        Args:
            unseen_w: Unknown cells that block the path.
            ahead_rad: Bearing of the path.
            view: Any view of the camera; before the first one there is none to choose.
            state: The drone's state.
            limits: Flight height, rates of turn and climb.
        """
        here = state.p_w[:2]
        if len(unseen_w) == 0:
            self.exhausted = Places(state.views, here)
            return False
        if view is None:
            return True
        if not self._place.is_near(here, PLACES_M):
            self._place, self._taken = Places(state.views, here), []
        for look in self._taken:
            unseen_w = unseen_w[~self._shows(look, unseen_w, here, view)]
        headings = ahead_rad + 2.0 * math.pi * np.arange(_HEADINGS) / _HEADINGS
        best, most = None, 0.0
        for look in (Look(float(heading), rise_m) for rise_m in (0.0, _RISE_M) for heading in headings):
            turn_s = abs(state.turn_to_rad(look.heading_rad)) / limits.turn_rad_s
            climb_m = abs(limits.height_m + look.rise_m - float(state.p_w[2])) + look.rise_m
            moves_s = max(turn_s, climb_m / limits.climb_m_s)
            gain = self._shows(look, unseen_w, here, view).sum() / (moves_s + _STANDS_S)
            if gain > most:
                best, most = look, gain
        self.look, self._since_s, self._stands_s = best, state.stamp_s, math.nan
        if best is None:
            self.exhausted = Places(state.views, here)
        return best is not None

    def look_ahead(self, state: DroneState) -> None:
        """Begin the view ahead from above: after take-off the space just ahead is below the picture's lower edge."""
        self.look, self._since_s, self._stands_s = Look(state.yaw_rad, _RISE_M), state.stamp_s, math.nan

    def taking(self, state: DroneState, height_m: float) -> Look | None:
        """The view that is being taken; a tracking loss ends it."""
        if self.look is None:
            return None
        turned = abs(state.turn_to_rad(self.look.heading_rad)) < _THERE_RAD
        if not turned or abs(state.p_w[2] - height_m - self.look.rise_m) > _THERE_M:
            self._stands_s = math.nan
        elif math.isnan(self._stands_s):
            self._stands_s = state.stamp_s
        late = state.stamp_s - self._since_s > _TIMEOUT_S
        if late or state.stamp_s - self._stands_s > _STANDS_S or not state.tracked:
            self._taken.append(self.look)
            self.look = None
        return self.look

    def _shows(self, look: Look, p_w: FloatArray, here: FloatArray, view: View) -> np.ndarray:
        """Which of the columns at points ``(U, 2)`` lie in the picture over their whole height."""
        c, s = math.cos(look.heading_rad), math.sin(look.heading_rad)
        mount, K = camera_on_body(), view.K
        shown = np.ones(len(p_w), dtype=bool)
        for z_m in (-self.half_m - look.rise_m, self.half_m - look.rise_m):
            step = p_w - here
            p_b = np.column_stack([step @ [c, s], step @ [-s, c], np.full(len(p_w), z_m)])
            p_c = (p_b - mount[:3, 3]) @ mount[:3, :3]
            z = np.maximum(p_c[:, 2], 1e-6)
            uv = p_c[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
            inside = ((uv > -0.5) & (uv < np.array(view.depth_m.shape[::-1]) - 0.5)).all(axis=1)
            shown &= inside & (p_c[:, 2] > 0.0)
        return shown
