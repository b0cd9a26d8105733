"""What a flight is for: where to go next, and when it is done."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edgeslam_torch.navigation.contact.losses import Losses
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.around import LooksAround
from edgeslam_torch.navigation.exploring.frontiers import WIDE_M, Looks, frontiers, reachable
from edgeslam_torch.navigation.exploring.second_look import SecondLook
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.types import FloatArray

ARRIVED_M = 0.15
MOST_LOSSES = 5
_MOST_DOUBT_M = 0.3
"""Doubt about where it is that may count as having arrived, at most."""
_NEAREST_M, _TRIES = 0.5, 3
"""How near its goal a drone stays that has lost its pose there, and was brought back, this often: what carries it on
are velocities that a Tello cuts off, and it would come no nearer until its battery is empty."""


class Task(Protocol):
    """One behaviour."""

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells ``(G, 2)`` worth going to; empty when there is nothing left to do."""

    def done(self, state: DroneState) -> bool:
        """Whether it is reached."""

    def gives_up(self, losses: int) -> bool:
        """Whether losing the pose so often about one place ends it."""

    def carry(self, update: MapUpdate) -> None:
        """Take remembered places along with the map."""

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """Take note of what looked like an opening from one place only, and of exits, before `goals` is asked."""

    def heading_rad(self, state: DroneState) -> float | None:
        """Where to look now, standing; None to look where it flies."""

    def faces_rad(self, state: DroneState) -> float | None:
        """Where to look while it flies, slowly and through what it knows; None to look where it flies."""


class LooksAhead:
    """Part of a task during which the drone looks where it flies, always, and at no opening, until its pose is lost
    again and again: each time is a turn back to what was known and the same way once more, and telemetry carries it by
    decimetres."""

    __slots__ = ()

    def gives_up(self, losses: int) -> bool:
        """After `MOST_LOSSES`."""
        return losses >= MOST_LOSSES

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """It does not."""

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
    """Near the goal."""

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """The goal's cell; where the grid ends, the last one towards it."""
        low = layer.corner_w + layer.cell_m
        high = layer.corner_w + (np.array(layer.free.shape) - 1) * layer.cell_m
        step = self.goal_w[:2] - state.p_w[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(step > 0, (high - state.p_w[:2]) / step, (low - state.p_w[:2]) / step)
        share = float(np.nanmin(np.where(step == 0, np.inf, room)))
        return layer.cells(state.p_w[:2] + min(1.0, share) * step)[None]

    def done(self, state: DroneState) -> bool:
        """Whether the drone is there, and slow; or as near as it can know.

        Before a bare wall telemetry carries it no farther, and a standard deviation of its metres may be more than what
        is left of the way.
        """
        away_m = self.away_m(state)
        if state.tracked or away_m < _NEAREST_M:
            self._losses.note(state)
        carried_out = not state.tracked and state.position_sigma_m >= DEAD_RECKONING_SIGMA_M
        reach_m = max(ARRIVED_M, min(_doubt_m(state), _MOST_DOUBT_M)) if carried_out else ARRIVED_M
        reach_m = _NEAREST_M if self._losses.count >= _TRIES else reach_m
        return away_m < reach_m and float(np.linalg.norm(state.velocity_w)) < 0.15

    def away_m(self, state: DroneState) -> float:
        """Level distance from the goal [m], by the drone's own pose."""
        return float(np.linalg.norm(state.p_w[:2] - self.goal_w[:2]))

    def carry(self, update: MapUpdate) -> None:
        """A goal in metres from the take-off stays what it is."""


def _doubt_m(state: DroneState) -> float:
    """Standard deviation of where it is in metres from the take-off."""
    return math.hypot(state.position_sigma_m, state.scale_sigma * float(np.linalg.norm(state.p_w[:2])))


@dataclass(slots=True)
class Explore:
    """Fly to where the known free space ends, until it ends nowhere or time is over, and look around on the way.

    A camera of 55 degrees that looks where it flies sees of the wall that it comes through the two jambs. What looks
    like an opening from one place only is looked at from another one.
    """

    until_s: float = np.inf
    """On the clock of the states."""
    _looks: Looks = field(default_factory=Looks)
    _around: LooksAround = field(default_factory=LooksAround)
    _second: SecondLook = field(default_factory=SecondLook)

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells to look from at what may be an opening, on the way; those at the middle of each wide border of the
        unseen, and to look from at what was not looked at from before, or may be an opening elsewhere, the nearest of
        which is flown to; then narrow borders, behind chairs and in corners, and openings once more that a look left in
        doubt.
        """
        here = state.p_w[:2]
        borders = self._looks.worth(reachable(frontiers(layer), layer, here), layer, state)
        if len(found := self._second.on_the_way(layer, state)):
            return self._goes_on(found)
        wide = (borders[:, None] == frontiers(layer, WIDE_M)).all(-1).any(1)
        found = np.concatenate([borders[wide], self._around.goals(layer, state), self._second.goals(layer, state)])
        if len(found):
            return self._goes_on(found)
        self._second.once_more(state.stamp_s)
        again = self._second.goals(layer, state)
        return np.concatenate([borders, self._goes_on(again)])

    def _goes_on(self, cells: np.ndarray) -> np.ndarray:
        """It is not over as long as there are cells."""
        if len(cells):
            self._looks.go_on()
        return cells

    def done(self, state: DroneState) -> bool:
        """Whether the time is over, or nothing is left to see."""
        return state.stamp_s >= self.until_s or self._looks.over(state.stamp_s)

    def carry(self, update: MapUpdate) -> None:
        """Take the places along that were looked at, and looked around at."""
        self._looks.carry(update)
        self._around.carry(update)
        self._second.carry(update)

    def gives_up(self, losses: int) -> bool:
        """No: there is elsewhere to look, and time is limited."""
        return False

    def consider(self, candidates: Sequence[Candidate], exits: Sequence[Exit] = ()) -> None:
        """What to look at once more."""
        self._second.consider(candidates)

    def heading_rad(self, state: DroneState) -> float | None:
        """At what it has not looked at from before, standing; at what may be an opening, where it shows."""
        around = self._around.heading_rad(state)
        return around if around is not None else self._second.heading_rad(state)

    def faces_rad(self, state: DroneState) -> float | None:
        """None: ahead."""
        return None
