"""Skills: explore, and find exits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.skills.skill import Result, Skill, since_s
from edgeslam_torch.navigation.views import ViewPlanner

_TURN_S = 4.0 * math.pi / NavLimits().turn_rad_s
"""Duration of the full turn, at half the rate, by which the pilot looks around without a path."""


@dataclass(slots=True)
class Explore(Skill):
    """Fly from viewpoint to viewpoint of the view planner, until none is left."""

    _nothing_s: float = math.nan
    """Since when there is none."""

    def goals(self, layer: Layer, state: DroneState, views: ViewPlanner) -> np.ndarray:
        """Viewpoints of borders of the free space, and of undecided openings."""
        found = views.viewpoints(layer, state)
        self._nothing_s = since_s(not len(found), self._nothing_s, state)
        return found

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """Reached when nothing is left to explore; tracking losses do not end it, since other places remain."""
        if state.stamp_s - self._nothing_s > _TURN_S:
            return Result(True, "nothing is left to explore")
        return super(Explore, self).result(state)

    def looks(self, state: DroneState, views: ViewPlanner) -> bool:
        """Where a view shows something."""
        return views.look_around(state)


@dataclass(slots=True)
class FindExits(Explore):
    """Explore until an exit is found."""

    _found: bool = False

    def consider(self, exits: Sequence[Exit]) -> None:
        """Receive exits."""
        self._found = bool(exits)

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """Reached with an exit only."""
        if self._found:
            return Result(True, "an exit was found")
        result = super(FindExits, self).result(state)
        return None if result is None else Result(False, result.reason)
