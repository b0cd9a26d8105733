"""Interface of a skill: a small state machine with one timeout and one stated result.

A skill chooses where to go (goal cells), where to look, and when to end; the planner (`navigation/pilot.py`) flies.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.views import ViewPlanner

MOST_LOSSES, FEW_LOSSES = 5, 3
"""Tracking losses at one place that end a skill: a view of a textureless surface fails repeatedly; and that end it at
its goal."""
ROUND_S = 15.0
"""Time without progress after which obstacles are observed anew, and then a skill ends: a full look around."""


@dataclass(frozen=True, slots=True)
class Result:
    """How a skill ended."""

    reached: bool
    reason: str


TIME_OVER = Result(True, "the time is over")
LOST_REPEATEDLY = Result(False, "tracking is lost there repeatedly")
NO_WAY = Result(False, "no way")


@dataclass(slots=True)
class Skill:
    """Base of all skills: it goes nowhere, faces the direction of flight, and ends by its timeout."""

    until_s: float = field(default=math.inf, kw_only=True)
    """Timeout on the clock of the states."""

    def goals(self, layer: Layer, state: DroneState, views: ViewPlanner) -> np.ndarray:
        """Goal cells ``(G, 2)``; by default the current one. Called at every plan."""
        return layer.cells(state.p_w[:2])[None]

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """The result, None while it runs; ``losses`` at the current place end it. Called for every state."""
        if state.stamp_s >= self.until_s:
            return TIME_OVER
        return LOST_REPEATEDLY if losses >= MOST_LOSSES else None

    def no_way(self) -> Result:
        """The result if the planner finds no way to the goals."""
        return NO_WAY

    def consider(self, exits: Sequence[Exit]) -> None:
        """Receive the exits known so far."""

    def looks(self, state: DroneState, views: ViewPlanner) -> bool:
        """Whether to hover and look; the view planner then takes the view. Called while it takes none."""
        return False

    def faces_rad(self, state: DroneState) -> float | None:
        """Heading to keep during slow flight through known space; None to face the direction of flight."""
        return None


def since_s(holds: bool, before_s: float, state: DroneState) -> float:
    """Since when a condition holds, given the same for the last state; NaN if it does not, or the supervisor flies."""
    if not holds or state.overridden:
        return math.nan
    return state.stamp_s if math.isnan(before_s) else before_s
