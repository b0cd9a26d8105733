"""Tasks of a flight: where to go next and when it is done."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edgeslam_torch.navigation.contact.losses import Losses
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import WIDE_M, Looks, frontiers, reachable
from edgeslam_torch.navigation.exploring.view_planner import ViewPlanner
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.types import FloatArray

ARRIVED_M = 0.15
MOST_LOSSES = 5
_MOST_DOUBT_M = 0.3
"""Upper bound of the position uncertainty that counts as arrived."""
_NEAREST_M, _TRIES = 0.5, 3
"""Distance from the goal that counts as arrived after tracking was lost near it this often: dead reckoning by truncated
velocities brings the drone no closer."""


class Task(Protocol):
    """Interface of a task."""

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Goal cells ``(G, 2)``; empty when nothing is left to do."""

    def done(self, state: DroneState) -> bool:
        """Whether the task is complete."""

    def gives_up(self, losses: int) -> bool:
        """Whether this many tracking losses at one place end the task."""

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive unconfirmed openings and exits; called before `goals`."""

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to turn to while hovering; None to face the direction of flight."""

    def faces_rad(self, state: DroneState) -> float | None:
        """Heading to keep during slow flight through known space; None to face the direction of flight."""


class LooksAhead:
    """Mixin: the drone faces the direction of flight, ignores openings, and gives up after repeated tracking losses."""

    __slots__ = ()

    def gives_up(self, losses: int) -> bool:
        """After `MOST_LOSSES` losses."""
        return losses >= MOST_LOSSES

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Ignore openings."""

    def heading_rad(self, state: DroneState) -> float | None:
        """None: ahead."""
        return None

    def faces_rad(self, state: DroneState) -> float | None:
        """None: ahead."""
        return None


@dataclass(slots=True)
class GoTo(LooksAhead):
    """Fly to a point."""

    goal_w: FloatArray
    """``(3,)`` in the drone's world [m]."""
    _losses: Losses = field(default_factory=lambda: Losses(math.inf))
    """Tracking losses near the goal."""

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """The goal's cell, or the last cell of the grid towards it."""
        low = layer.corner_w + layer.cell_m
        high = layer.corner_w + (np.array(layer.free.shape) - 1) * layer.cell_m
        step = self.goal_w[:2] - state.p_w[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(step > 0, (high - state.p_w[:2]) / step, (low - state.p_w[:2]) / step)
        share = float(np.nanmin(np.where(step == 0, np.inf, room)))
        return layer.cells(state.p_w[:2] + min(1.0, share) * step)[None]

    def done(self, state: DroneState) -> bool:
        """Whether the drone is at the goal and slow, within its position uncertainty.

        Near a bare wall tracking is lost, and the uncertainty may exceed the remaining distance.
        """
        away_m = self.away_m(state)
        if state.tracked or away_m < _NEAREST_M:
            self._losses.note(state)
        carried_out = not state.tracked and state.position_sigma_m >= DEAD_RECKONING_SIGMA_M
        reach_m = max(ARRIVED_M, min(_doubt_m(state), _MOST_DOUBT_M)) if carried_out else ARRIVED_M
        reach_m = _NEAREST_M if self._losses.count >= _TRIES else reach_m
        return away_m < reach_m and float(np.linalg.norm(state.velocity_w)) < 0.15

    def away_m(self, state: DroneState) -> float:
        """Horizontal distance to the goal [m] by the estimated pose."""
        return float(np.linalg.norm(state.p_w[:2] - self.goal_w[:2]))


def _doubt_m(state: DroneState) -> float:
    """Standard deviation [m] of the position relative to the take-off."""
    return math.hypot(state.position_sigma_m, state.scale_sigma * float(np.linalg.norm(state.p_w[:2])))


@dataclass(slots=True)
class Explore(LooksAhead):
    """Frontier exploration with looks to the sides, until no frontier is left or the time is over.

    A camera with a 55 degree field of view does not see the wall that the drone comes through, hence the looks to the
    sides. An opening seen from one place only is inspected from a second one.
    """

    until_s: float = np.inf
    """On the clock of the states."""
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

    def done(self, state: DroneState) -> bool:
        """Whether the time is over or nothing is left to explore."""
        return state.stamp_s >= self.until_s or self._looks.over(state.stamp_s)

    def gives_up(self, losses: int) -> bool:
        """Never: other places are left, and time is limited."""
        return False

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Receive candidate openings."""
        self._views.consider(candidates)

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to an undecided opening or an uncovered border visible from here."""
        return self._views.heading_rad(state)
