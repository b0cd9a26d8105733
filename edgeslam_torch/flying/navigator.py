"""Flight API: `Navigator.open`, `take_off`, `go_to`, `follow_corridor`, `find_exits`, `return_home`, `land`."""

import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from edgeslam_torch.calibration.camera_choice import GUESS
from edgeslam_torch.drone.address import TelloAddress
from edgeslam_torch.flying.checks import check_fit, check_goal
from edgeslam_torch.flying.flight_controller import FlightController, Listener
from edgeslam_torch.flying.recorder import Recorder
from edgeslam_torch.flying.result import FlightRefused, FlightResult
from edgeslam_torch.flying.simulated import is_simulated, site_of
from edgeslam_torch.flying.vehicle import Vehicle
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.openings.pathways import Pathway, pathways
from edgeslam_torch.navigation.skills.explore import Explore, FindExits
from edgeslam_torch.navigation.skills.follow_corridor import FollowCorridor
from edgeslam_torch.navigation.skills.go_to import GoTo
from edgeslam_torch.navigation.skills.return_home import ReturnHome
from edgeslam_torch.navigation.skills.skill import Result, Skill
from edgeslam_torch.navigation.skills.take_off import TakeOff
from edgeslam_torch.types import FloatArray

HOME_BECAUSE = "battery low: return home"
DEAD_RECKONING = "by dead reckoning: tracking is lost"
UNRELATED = "in a submap that is not connected to that of the take-off"
UNCERTAIN = "to {:.2g} m: uncertainty of this submap relative to that of the take-off"
"""Qualifications of a result whose pose is uncertain."""
BEYOND_M = 0.8
"""Distance behind an exit at which the drone stops."""


class Navigator:
    """A drone that navigates by its own map. Use it as a context manager: leaving it lands.

    Positions are in the drone's world: origin on the floor below the take-off, x along the heading there, y left,
    z up [m].

    Example:
        >>> from edgeslam_torch.flying.navigator import Navigator
        >>> with Navigator.open("sim://cluttered_room", allow_motion=True) as nav:  # doctest: +SKIP
        ...     nav.take_off()
        ...     print(nav.go_to((3.0, 0.0, 1.15)))
    """

    def __init__(
        self,
        vehicle: Vehicle,
        flight_controller: FlightController,
        allow_motion: bool = False,
        recorder: Recorder | None = None,
    ) -> None:
        """Use `open` instead."""
        self.recorder = recorder
        self.vehicle, self.flight_controller, self.allow_motion = vehicle, flight_controller, allow_motion
        self.limits = flight_controller.limits

    @classmethod
    def open(
        cls,
        location: str = "tello://",
        allow_motion: bool = False,
        limits: NavLimits | None = None,
        camera: str | Path | None = None,
        listeners: Sequence[Listener] = (),
        record: str | Path | None = None,
    ) -> "Navigator":
        """Connect; nothing moves.

        Args:
            location: ``tello://HOST...`` for a drone or ``edgeslam sim``; ``sim://WORLD[:SEED]`` for an emulated drone
                on a simulated clock, without network.
            allow_motion: Whether the drone may fly at all.
            limits: Limits of the flight.
            camera: Calibration; the Tello's when None.
            listeners: Called in every control cycle.
            record: Folder to record the flight to; none by default.

        Raises:
            SourceError: If the location is invalid or the drone does not answer.
            CalibrationError: If the calibration is malformed.
            OutputError: If the folder holds a recording already or cannot be written.
        """
        limits = limits or NavLimits()
        recorder = None if record is None else Recorder(Path(record), limits)
        if recorder is None:
            flight_controller = FlightController(limits, listeners)
        else:
            flight_controller = FlightController(limits, [*listeners, recorder.moment], recorder.planner)
        vehicle: Vehicle
        if is_simulated(location):
            from edgeslam_torch.flying.lockstep_vehicle import LockstepVehicle

            vehicle = LockstepVehicle(site_of(location), flight_controller, recorder=recorder)
        else:
            from edgeslam_torch.flying.udp_vehicle import UdpVehicle

            address = TelloAddress.parse(location)
            vehicle = UdpVehicle(address, flight_controller, allow_motion, camera, recorder=recorder)
        return cls(vehicle, flight_controller, allow_motion, recorder)

    def __enter__(self) -> "Navigator":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Land if flying, and disconnect."""
        try:
            self.vehicle.close()
        finally:
            if self.recorder is not None:
                self.recorder.close()

    def take_off(self) -> FlightResult:
        """Take off, rise to the flight height, and wait for the metric scale.

        Raises:
            FlightRefused: If flying is not allowed or not advisable.
            TelloError: If the drone does not take off.
        """
        if self.vehicle.flying:
            raise FlightRefused("already flying")
        if self.vehicle.over:
            raise FlightRefused(f"this flight has ended ({self.vehicle.over}); open a new navigator for the next one")
        check_fit(self.allow_motion, self.vehicle.battery, self.limits, self.vehicle.camera.source.startswith(GUESS))
        self.flight_controller.before_take_off()
        self.vehicle.take_off()
        return self.fly(TakeOff(self.limits.height_m))

    def go_to(self, goal_w: Sequence[float] | FloatArray) -> FlightResult:
        """Fly to a point ``(3,)`` around obstacles, at the flight height; the point must be near that height.

        Near a bare wall, where tracking is lost, it stops up to half a metre away, and the reason says so.

        Raises:
            FlightRefused: If the point is invalid, beyond the fence, inside an obstacle or at another height; or if the
                scale is not metric yet.
        """
        return self.fly(GoTo(self._goal(goal_w)))

    def explore(self, seconds: float) -> FlightResult:
        """Explore by frontiers; reached when the time is over or nothing is left to explore.

        Raises:
            FlightRefused: If the time is not positive or the drone is not flying.
        """
        return self.fly(Explore(until_s=self._until_s(seconds)))

    def find_exits(self, seconds: float = 180.0) -> FlightResult:
        """Explore until an exit is found; `exits` returns it.

        Raises:
            FlightRefused: As `explore`.
        """
        return self.fly(FindExits(until_s=self._until_s(seconds)))

    def exits(self) -> tuple[Exit, ...]:
        """Door-sized openings in walls, confirmed from two viewpoints so far, the nearest first."""
        return self.flight_controller.exits()

    def pathways(self) -> list[Pathway]:
        """Free corridors around the drone, the longest first.

        Raises:
            FlightRefused: If the drone is not flying.
        """
        return pathways(self.flight_controller.walls(), self._flying_state().p_w[:2])

    def go_through(self, exit_: Exit) -> FlightResult:
        """Fly through an exit of `exits` and stop `BEYOND_M` behind it.

        Raises:
            FlightRefused: As `go_to`.
        """
        there = exit_.beyond(BEYOND_M)
        return self.fly(GoTo(self._goal([there[0], there[1], self.limits.height_m]), "through the exit"))

    def follow_corridor(self, seconds: float = 120.0) -> FlightResult:
        """Follow the current corridor ahead and around corners, through no known door.

        "the corridor ends" means that a wall is ahead and that no continuation was seen; one may still exist.

        Raises:
            FlightRefused: As `explore`.
        """
        return self.fly(FollowCorridor(until_s=self._until_s(seconds)))

    def return_home(self) -> FlightResult:
        """Fly back to the take-off, along the path flown while it is far.

        Raises:
            FlightRefused: If the drone is not flying.
        """
        self._flying_state()
        return self.fly(ReturnHome(self.flight_controller.track()))

    def fly(self, skill: Skill) -> FlightResult:
        """Execute a skill of `navigation.skills`; return home and land when the battery is low."""
        controller, homewards = self.flight_controller, isinstance(skill, ReturnHome)
        controller.begin(skill)
        self.vehicle.fly(lambda: controller.result() is not None or (not homewards and self._wants_home()))
        path_m, clearance_m = controller.flown()
        if not self.vehicle.flying:
            return FlightResult(False, self.vehicle.over, clearance_m, path_m)
        result = controller.result()
        if result is None:
            result = Result(False, HOME_BECAUSE)
            self.return_home()
            self._land(HOME_BECAUSE)
        reason = result.reason + self._rests_on() if result.reached else result.reason
        return FlightResult(result.reached, reason, clearance_m, path_m)

    def land(self) -> FlightResult:
        """Land; reached when the drone reports that it stands.

        Raises:
            FlightRefused: If the drone is not flying.
        """
        if not self.vehicle.flying:
            raise FlightRefused(f"not flying{f': {self.vehicle.over}' if self.vehicle.over else ''}")
        path_m, clearance_m = self.flight_controller.flown()
        self._land("as commanded")
        return FlightResult(self.vehicle.over == "as commanded", f"landed: {self.vehicle.over}", clearance_m, path_m)

    def _land(self, why: str) -> None:
        self.flight_controller.land(why)
        self.vehicle.fly(lambda: False)

    def _goal(self, goal_w: Sequence[float] | FloatArray) -> FloatArray:
        goal = check_goal(goal_w, self.limits)
        self._flying_state()
        return check_goal(goal, self.limits, self.flight_controller.walls().layer)

    def _flying_state(self) -> DroneState:
        """Newest state of a flight with metric scale.

        Raises:
            FlightRefused: If there is none.
        """
        state = self.flight_controller.state
        if not self.vehicle.flying or state is None:
            why = f" ({self.vehicle.over})" if self.vehicle.over else ": take off first"
            raise FlightRefused(f"not flying{why}")
        if not state.metric:
            raise FlightRefused(
                "the map has no metric scale yet, so a position in metres is undefined; take_off() waits for it"
            )
        return state

    def _until_s(self, seconds: float) -> float:
        """End time after so many seconds.

        Raises:
            FlightRefused: If the time is out of range or the drone is not flying.
        """
        if not 0 < seconds < 3600:
            raise FlightRefused(f"the time must be more than 0 s and less than an hour, got {seconds} s")
        return self._flying_state().stamp_s + seconds

    def _rests_on(self) -> str:
        """Qualification of a reached result by the uncertainty of the pose."""
        state = self.flight_controller.state
        if state is None:
            return ""
        if not state.tracked:
            return f", {DEAD_RECKONING}"
        if math.isinf(state.submap_sigma_m):
            return f", {UNRELATED}"
        return f", {UNCERTAIN.format(state.submap_sigma_m)}" if state.submap_sigma_m > 0 else ""

    def _wants_home(self) -> bool:
        return self.flight_controller.last is not None and self.flight_controller.last.home
