"""Skills: explore, and find exits."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import WIDE_M, Looks, frontiers, reachable
from edgeslam_torch.navigation.exploring.view_planner import ViewPlanner
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit
from edgeslam_torch.navigation.skills.skill import Result, Skill


@dataclass(slots=True)
class Explore(Skill):
    """Frontier exploration by the view planner, until no frontier is left."""

    _looks: Looks = field(default_factory=Looks)
    _views: ViewPlanner = field(default_factory=ViewPlanner)

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Viewpoints of undecided openings near the path; else these and wide frontiers and viewpoints of uncovered
        borders; else narrow frontiers. Exploration is not over while there are any."""
        borders = self._looks.worth(reachable(frontiers(layer), layer, state.p_w[:2]), layer, state)
        wide = (borders[:, None] == frontiers(layer, WIDE_M)).all(-1).any(1)
        found = self._views.goals(layer, state, borders[wide])
        if len(found):
            self._looks.go_on()
        return found if len(found) else borders

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """Reached when nothing is left to explore; tracking losses do not end it, since other places remain."""
        if self._looks.over(state.stamp_s):
            return Result(True, "nothing is left to explore")
        return super(Explore, self).result(state)

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive undecided openings."""
        self._views.consider(candidates)

    def look_rad(self, state: DroneState) -> float | None:
        """Heading to an undecided opening or an uncovered border visible from here."""
        return self._views.heading_rad(state)


@dataclass(slots=True)
class FindExits(Explore):
    """Explore until an exit is found."""

    _found: bool = False

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive undecided openings and exits."""
        super(FindExits, self).consider(candidates)
        self._found = bool(exits)

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """Reached with an exit only."""
        if self._found:
            return Result(True, "an exit was found")
        result = super(FindExits, self).result(state)
        return None if result is None else Result(False, result.reason)
