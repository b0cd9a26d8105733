"""Pilot and supervisor of one flight, which threads share: what is seen goes in, what is flown comes out."""

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.flying.tasks import Stay
from edgeslam_torch.navigation.drone_state import Contact, DroneState
from edgeslam_torch.navigation.flight_record import Decision, NewTask
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.openings.wall_frame import Walls
from edgeslam_torch.navigation.pilot import Phase, Pilot
from edgeslam_torch.navigation.supervisor import Order, Supervisor
from edgeslam_torch.navigation.tasks import Task
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

_STEP_M = 0.1
"""Distance between points of the track."""


@dataclass(frozen=True, slots=True)
class Moment:
    """What was known and decided at one moment, for recorders and viewers."""

    state: DroneState
    order: Order
    phase: Phase
    pilot: Pilot
    """For its layer and its way; another thread may be changing it."""


Witness = Callable[[NewTask | Contact | DroneState | Decision], None]
"""Told what the planner is given, before it thinks, and what it decided, from the thread that plans."""
Listener = Callable[[Moment], None]
"""Called for every moment from the thread that flies: it must return at once."""


class FlightController:
    """One flight's pilot and supervisor.

    `plan` is called from one thread, which may hang; `order` from another, which must not wait for it: they share
    only a command and a lock that is held for microseconds.
    """

    def __init__(
        self, limits: NavLimits, listeners: Sequence[Listener] = (), witness: Witness = lambda entry: None
    ) -> None:
        self.limits = limits
        self.pilot = Pilot(Stay(), limits)
        self.state: DroneState | None = None
        """The newest."""
        self.last: Order | None = None
        self._supervisor = Supervisor(limits)
        self._listeners = list(listeners)
        self._witness = witness
        self._lock = threading.Lock()
        self._next: Task | None = None
        self._hold = False
        self._contact: Contact | None = None
        """What was felt since the pilot planned last."""
        self._track: list[FloatArray] = []
        self._path_m, self._clearance_m = 0.0, math.nan

    def begin(self, task: Task) -> None:
        """Give the pilot another task, which it takes up the next time that it plans."""
        with self._lock:
            self._next = task
            self._path_m, self._clearance_m = 0.0, math.nan

    def ended(self) -> Phase | None:
        """How the present task ended; None while it is flown or not yet taken up."""
        with self._lock:
            phase = self.pilot.phase
            return phase if self._next is None and phase in (Phase.DONE, Phase.STUCK) else None

    def hold(self, hold: bool) -> None:
        """Hover whatever the pilot wants, until it is called off: for a person at the keyboard."""
        self._hold = hold

    def feel(self, contact: Contact) -> None:
        """Let the pilot know of something that it does not see, when it plans next."""
        with self._lock:
            self._contact = contact

    def plan(self, state: DroneState) -> Decision:
        """Let the pilot decide; may take its time, or hang."""
        with self._lock:
            task, self._next = self._next, None
            contact, self._contact = self._contact, None
            if task is not None:
                self._take_up(task)
            if self.last is not None and not self.last.follows:
                state = replace(state, overridden=True)
        if task is not None:
            self._witness(NewTask(task))
        if state.map_update is not None:
            self._carry(state.map_update)
        if contact is not None:
            self._witness(contact)
            self.pilot.add_contact(contact)
        self._witness(state)
        command = self.pilot.update(state)
        with self._lock:
            self._supervisor.propose(command, state.stamp_s)
        decision = Decision(command, str(self.pilot.phase))
        self._witness(decision)
        self._note_clearance(state)
        return decision

    def _carry(self, update: MapUpdate) -> None:
        """Take the way flown along with the map; the pilot does so itself."""
        with self._lock:
            self._track = list(update.points(np.array(self._track).reshape(-1, 2)))
            self._supervisor.carry(update)

    def _take_up(self, task: Task) -> None:
        """A first look that is under way is finished."""
        if self.pilot.phase in (Phase.RISING, Phase.SWEEPING, Phase.SINKING):
            self.pilot.task = task
        else:
            self.pilot.begin(task)

    def order(self, state: DroneState) -> Order:
        """What the drone is told now: takes microseconds, whatever the pilot does."""
        with self._lock:
            self._supervisor.see(state)
            self._supervisor.hold = self._hold
            order = self._supervisor.order(state.stamp_s)
        if order.contact is not None:
            self.feel(order.contact)
        self._note_path(state)
        self.state, self.last = state, order
        self._tell(Moment(state, order, self.pilot.phase, self.pilot))
        return order

    def _tell(self, moment: Moment) -> None:
        """A listener that fails must not end a flight."""
        for listener in list(self._listeners):
            try:
                listener(moment)
            except Exception:
                logger.exception("a listener to the flight failed and is not called again")
                self._listeners.remove(listener)

    def known(self) -> Layer:
        """What the pilot knows of its height of flight."""
        return self.pilot.walls().layer

    def walls(self) -> Walls:
        """The same, and what of it stands upright."""
        return self.pilot.walls()

    def exits(self) -> tuple[Exit, ...]:
        """What it found of exits, the nearest first."""
        return self.pilot.exits.exits

    def track(self) -> FloatArray:
        """``(N, 2)`` where it flew, oldest first."""
        with self._lock:
            return np.array(self._track).reshape(-1, 2)

    def flown(self) -> tuple[float, float]:
        """Way and least clearance of the present task [m]; the clearance is NaN where nothing solid was seen."""
        with self._lock:
            return self._path_m, self._clearance_m

    def _note_path(self, state: DroneState) -> None:
        here = state.p_w[:2]
        with self._lock:
            step = float(np.linalg.norm(here - self._track[-1])) if self._track else 0.0
            if self._track and step < _STEP_M:
                return
            self._track.append(here.copy())
            self._path_m += step

    def _note_clearance(self, state: DroneState) -> None:
        layer = self.pilot.layer
        if layer is None or not layer.solid.any():
            return
        i, j = layer.cells(state.p_w[:2])
        away = float(layer.from_solid_m[i, j]) - self.limits.radius_m
        with self._lock:
            self._clearance_m = away if math.isnan(self._clearance_m) else min(self._clearance_m, away)
