"""Planner and supervisor of one flight, shared by threads: states go in, orders come out."""

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.navigation.drone_state import Contact, DroneState
from edgeslam_torch.navigation.flight_record import Decision, NewSkill
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.openings.wall_frame import Walls
from edgeslam_torch.navigation.pilot import Phase, Pilot
from edgeslam_torch.navigation.skills.skill import Result, Skill
from edgeslam_torch.navigation.space import CELL_M
from edgeslam_torch.navigation.supervisor import Order, Supervisor
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Moment:
    """State and decision of one control cycle, for recorders and viewers."""

    state: DroneState
    order: Order
    phase: Phase
    pilot: Pilot
    """For its layer and its path; another thread may be changing it."""


Witness = Callable[[NewSkill | Contact | DroneState | Decision], None]
"""Called by the planning thread with every input before it is processed, and with every decision."""
Listener = Callable[[Moment], None]
"""Called by the control thread in every cycle; it must return at once."""


class FlightController:
    """Planner and supervisor of one flight.

    `plan` runs in one thread, which may hang; `order` in another, which must not wait for it. They share only a command
    and a lock that is held for microseconds.
    """

    def __init__(
        self, limits: NavLimits, listeners: Sequence[Listener] = (), witness: Witness = lambda entry: None
    ) -> None:
        self.limits = limits
        self.pilot = Pilot(Skill(), limits)
        self.state: DroneState | None = None
        """Newest state."""
        self.last: Order | None = None
        self._supervisor = Supervisor(limits, self.pilot.views)
        self._listeners = list(listeners)
        self._witness = witness
        self._lock = threading.Lock()
        self._next: Skill | None = None
        self._hold, self._land_because = False, ""
        self._contact: Contact | None = None
        """Contact since the last planning cycle."""
        self._track = Places()
        self._path_m, self._clearance_m = 0.0, math.nan

    def begin(self, skill: Skill) -> None:
        """Set another skill; it starts in the next planning cycle."""
        with self._lock:
            self._next = skill
            self._path_m, self._clearance_m = 0.0, math.nan

    def result(self) -> Result | None:
        """How the current skill ended; None while it runs or has not started."""
        with self._lock:
            return self.pilot.result if self._next is None else None

    def hold(self, hold: bool) -> None:
        """Hover, overriding the planner, until released; for an operator at the keyboard."""
        self._hold = hold

    def before_take_off(self) -> None:
        """Drop a landing that was ordered on the ground; one that is ordered during the take-off counts."""
        self._land_because = ""

    def land(self, why: str) -> None:
        """Land instead of following the planner, and return at once; callable from a signal handler."""
        self._land_because = self._land_because or why

    def feel(self, contact: Contact) -> None:
        """Pass an unseen obstacle to the planner's next cycle."""
        with self._lock:
            self._contact = contact

    def plan(self, state: DroneState) -> Decision:
        """Run a planning cycle; may be slow or hang."""
        with self._lock:
            skill, self._next = self._next, None
            contact, self._contact = self._contact, None
            if skill is not None:
                self.pilot.begin(skill)
            if self.last is not None and not self.last.follows:
                state = replace(state, overridden=True)
        if skill is not None:
            self._witness(NewSkill(skill))
        if contact is not None:
            self._witness(contact)
            self.pilot.add_contact(contact)
        self._witness(state)
        command = self.pilot.update(state)
        with self._lock:
            self._supervisor.propose(command, state.stamp_s)
        decision = Decision(command, str(self.pilot.phase))
        self._witness(decision)
        away_m = hull_clearance_m(self.pilot, state)
        with self._lock:
            self._clearance_m = float(np.fmin(self._clearance_m, away_m))
        return decision

    def order(self, state: DroneState) -> Order:
        """Order for the drone now; takes microseconds, whatever the planner does."""
        with self._lock:
            self._supervisor.see(state)
            self._supervisor.hold = self._hold
            self._supervisor.landing = self._supervisor.landing or self._land_because
            order = self._supervisor.order(state.stamp_s)
        if order.contact is not None:
            self.feel(order.contact)
        self._note_path(state)
        self.state, self.last = state, order
        self._tell(Moment(state, order, self.pilot.phase, self.pilot))
        return order

    def _tell(self, moment: Moment) -> None:
        """Call the listeners; one that fails is removed and does not end the flight."""
        for listener in list(self._listeners):
            try:
                listener(moment)
            except Exception:
                logger.exception("a listener to the flight failed and is not called again")
                self._listeners.remove(listener)

    def walls(self) -> Walls:
        """Layer at the flight height, with its upright cells."""
        return self.pilot.walls()

    def exits(self) -> tuple[Exit, ...]:
        """Exits found so far, the nearest first."""
        return self.pilot.exits.exits

    def track(self) -> FloatArray:
        """``(N, 2)`` path flown, oldest first."""
        with self._lock:
            return self._track.p_w

    def flown(self) -> tuple[float, float]:
        """Path length and minimum clearance of the current skill [m]; the clearance is NaN without obstacles."""
        with self._lock:
            return self._path_m, self._clearance_m

    def _note_path(self, state: DroneState) -> None:
        here = state.p_w[:2]
        with self._lock:
            step = float(np.linalg.norm(here - self._track.last_w)) if len(self._track) else 0.0
            if len(self._track) and step < CELL_M:
                return
            self._track.add(self._supervisor.views, here)
            self._path_m += step


def hull_clearance_m(pilot: Pilot, state: DroneState) -> float:
    """Distance [m] between the hull and the nearest mapped obstacle; NaN without one."""
    layer = pilot.layer  # another thread may replace it
    if layer is None or not layer.solid.any():
        return math.nan
    i, j = layer.cells(state.p_w[:2])
    return float(layer.from_solid_m[i, j]) - pilot.limits.radius_m
