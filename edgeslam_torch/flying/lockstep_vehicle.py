"""Emulated drone on a simulated clock, for flights that are deterministic under any machine load."""

import math
from collections.abc import Callable

from edgeslam_torch.drone.answers import TelloError
from edgeslam_torch.drone.emulator.lockstep import Event, LockstepTello, Picture, Reply, State
from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.drone.sdk_state import parse_state
from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.flying.perception.slam_perception import SlamPerception
from edgeslam_torch.flying.recorder import Recorder
from edgeslam_torch.flying.vehicle import TICK_S
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import Frame

IMAGE_SIZE = (480, 360)
_ANSWER_S = 20.0


class LockstepVehicle:
    """Perception, flight controller and `LockstepTello` in one thread.

    Args:
        site: World of the flight.
        flight_controller: Flight controller.
        tello: Emulated drone; a healthy one in still air at the site's start when None.
        recorder: Receives every frame and state message.
    """

    def __init__(
        self,
        site: Site,
        flight_controller: FlightController,
        tello: LockstepTello | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        drone, paint, self.camera = drone_at(site, TELLO_TILT_RAD, IMAGE_SIZE, ready=False)
        self.tello = tello or LockstepTello(drone, paint, seed=site.seed)
        self.over = ""
        self.flying = False
        self.battery = math.nan
        self._flight_controller = flight_controller
        self._perception = SlamPerception(self.camera, site.seed)
        self._view: View | None = None
        self._recorder, self._pictures = recorder, 0
        if recorder is not None:
            recorder.begin(self.camera)

    def take_off(self) -> None:
        """As `Vehicle`.

        Raises:
            TelloError: If the drone does not take off.
        """
        self._ask("takeoff")
        self.flying = True

    def fly(self, until: Callable[[], bool]) -> None:
        """As `Vehicle`."""
        while self.flying and not until():
            self._tick()
            state = self._perception.state(self.tello.clock_s, self._view)
            self._view = None
            self._flight_controller.plan(state)
            order = self._flight_controller.order(state)
            if order.land:
                self._land(order.command.why)
            else:
                right, forward, up, clockwise = (round(100 * v) for v in order.command.sticks())
                self.tello.send(f"rc {right} {forward} {up} {clockwise}")

    def close(self) -> None:
        """As `Vehicle`."""
        if self.flying:
            self._land("the program left")
        self._perception.close()

    def _land(self, why: str) -> None:
        self.flying, self.over = False, why
        self._ask("land")

    def _tick(self) -> list[Event]:
        events = self.tello.advance(TICK_S)
        for event in events:
            if isinstance(event, State):
                self._on_state(StateMessage(event.arrived_s, event.text, parse_state(event.text)))
            elif isinstance(event, Picture):
                self._see(event)
        return events

    def _on_state(self, message: StateMessage) -> None:
        sample = message.sample()
        self.battery = sample.battery
        self._perception.add_telemetry(sample)
        if self._recorder is not None:
            self._recorder.state(message)

    def _see(self, picture: Picture) -> None:
        self._view = self._perception.seen(picture.image, picture.arrived_s, picture.captured_s) or self._view
        if self._recorder is not None:
            self._recorder.picture(Frame(self._pictures, picture.arrived_s, picture.image))
        self._pictures += 1

    def _ask(self, command: str) -> None:
        """Send a command and advance the clock until it is answered."""
        self.tello.send(command)
        until_s = self.tello.clock_s + _ANSWER_S
        while self.tello.clock_s < until_s:
            for event in self._tick():
                if isinstance(event, Reply) and event.text.lower().startswith("ok"):
                    return
                if isinstance(event, Reply) and event.text.lower().startswith("error"):
                    raise TelloError(f"{command!r} was refused: {event.text}")
        raise TelloError(f"no answer to {command!r} in {_ANSWER_S:.0f} s")
