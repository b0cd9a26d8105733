"""Skill: rise to the flight height, and wait for the metric scale."""

import math
from dataclasses import dataclass

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.skills.skill import NO_WAY, Result, Skill
from edgeslam_torch.navigation.views import ViewPlanner

_TIMEOUT_S = 40.0
"""The metric scale takes up to 20 s, a second map as long."""


@dataclass(slots=True)
class TakeOff(Skill):
    """Rise and hover.

    Args:
        height_m: Flight height.
    """

    height_m: float
    _began_s: float = math.nan

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """At the flight height, in metres."""
        self._began_s = state.stamp_s if math.isnan(self._began_s) else self._began_s
        if state.metric and abs(state.p_w[2] - self.height_m) < 0.1:
            return Result(True, "in the air")
        return NO_WAY if state.stamp_s - self._began_s > _TIMEOUT_S else None

    def looks(self, state: DroneState, views: ViewPlanner) -> bool:
        """It hovers."""
        return True
