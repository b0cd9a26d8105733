"""Skill: fly to a point."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.skills.skill import FEW_LOSSES, Result, Skill
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.navigation.views import ViewPlanner
from edgeslam_torch.types import FloatArray

ARRIVED_M = 0.15
SLOW_M_S = 0.15
_MOST_DOUBT_M = 0.3
"""Upper bound of the position uncertainty that counts as arrived."""
_NEAREST_M = 0.5
"""Distance from the goal that counts as arrived after tracking was lost near it `FEW_LOSSES` times: dead reckoning by
truncated velocities brings the drone no closer."""


@dataclass(slots=True)
class GoTo(Skill):
    """Fly to a point around obstacles."""

    goal_w: FloatArray
    """``(3,)`` in the drone's world [m]."""
    there: str = "there"
    """Reason of its result."""

    def goals(self, layer: Layer, state: DroneState, views: ViewPlanner) -> np.ndarray:
        """The goal's cell, or the last cell of the grid towards it."""
        low = layer.corner_w + layer.cell_m
        high = layer.corner_w + (np.array(layer.free.shape) - 1) * layer.cell_m
        step = self.goal_w[:2] - state.p_w[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(step > 0, (high - state.p_w[:2]) / step, (low - state.p_w[:2]) / step)
        share = float(np.nanmin(np.where(step == 0, np.inf, room)))
        return layer.cells(state.p_w[:2] + min(1.0, share) * step)[None]

    def result(self, state: DroneState, losses: int = 0) -> Result | None:
        """At the goal and slow, within the position uncertainty.

        Near a bare wall tracking is lost, and the uncertainty may exceed the remaining distance.
        """
        away_m = float(np.linalg.norm(state.p_w[:2] - self.goal_w[:2]))
        carried_out = not state.tracked and state.position_sigma_m >= DEAD_RECKONING_SIGMA_M
        reach_m = max(ARRIVED_M, min(_doubt_m(state), _MOST_DOUBT_M)) if carried_out else ARRIVED_M
        reach_m = _NEAREST_M if losses >= FEW_LOSSES else reach_m
        if away_m >= reach_m or float(np.linalg.norm(state.velocity_w)) >= SLOW_M_S:
            return super(GoTo, self).result(state, losses)
        near = away_m <= ARRIVED_M
        return Result(True, self.there if near else f"{self.there}, {away_m:.2f} m from it by the estimated pose")


def _doubt_m(state: DroneState) -> float:
    """Standard deviation [m] of the position relative to the take-off."""
    return math.hypot(state.position_sigma_m, state.scale_sigma * float(np.linalg.norm(state.p_w[:2])))
