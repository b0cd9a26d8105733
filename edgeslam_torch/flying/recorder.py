"""Recording of a flight: frames and state like any recording, plus states and decisions."""

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.errors import EdgeSlamError, OutputError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.flying.flight_controller import Moment, hull_clearance_m
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.navigation.drone_state import Contact, DroneState
from edgeslam_torch.navigation.flight_record import PLAN, Decision, NewSkill, PlanLog
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.types import Frame
from edgeslam_torch.writers.flight_writer import FlightWriter

logger = logging.getLogger(__name__)

MOMENTS = "moments.csv"
EXITS = "exits.csv"
_EXIT_COLUMNS = "x_m,y_m,normal_x,normal_y,width_m,width_sigma_m,position_sigma_m,places"
_COLUMNS = (
    "stamp_s,x_m,y_m,z_m,yaw_rad,vx_m_s,vy_m_s,vz_m_s,position_sigma_m,scale_sigma,metric,tracked,blind_s,battery,"
    "revision,clearance_m,phase,danger,forward_m_s,left_m_s,up_m_s,turn_left_rad_s,why"
)


class Recorder:
    """Writes a folder for ``edgeslam run``, with `MOMENTS` (one line per order), `EXITS` (the final ones) and
    ``plan.jsonl`` for ``edgeslam fly replay``.

    A full disk ends the recording, not the flight.

    Args:
        folder: Output folder, created by `begin`.
        limits: Limits of the flight.
    """

    def __init__(self, folder: Path, limits: NavLimits) -> None:
        self.folder, self._limits = folder, limits
        self.failure: OutputError | None = None
        """Why the recording ended early."""
        self._writer: FlightWriter | None = None
        self._moments: Appender | None = None
        self._plan: PlanLog | None = None
        self._exits: tuple[Exit, ...] = ()
        self._lock = threading.Lock()

    def begin(self, camera: Camera) -> None:
        """Create the folder.

        Raises:
            OutputError: If it holds a recording already or cannot be written.
        """
        self._writer = FlightWriter(self.folder, camera, with_telemetry=True)
        self._moments = Appender(self.folder / MOMENTS, _COLUMNS + "\n")
        self._plan = PlanLog(self.folder / PLAN, self._limits)

    def picture(self, frame: Frame) -> None:
        """Write a frame."""
        with self._lock:
            if self._writer is not None:
                self._guarded(lambda writer: writer.add_frame(frame))

    def state(self, message: StateMessage) -> None:
        """Write a state message."""
        with self._lock:
            if self._writer is not None:
                self._guarded(lambda writer: writer.add_state(message))

    def moment(self, moment: Moment) -> None:
        """Write a control cycle."""
        with self._lock:
            moments = self._moments
            if moments is not None:
                self._guarded(lambda _: moments.write(_line(moment)))
                self._note_exits(moment.pilot.exits.exits)

    def planner(self, entry: NewSkill | Contact | DroneState | Decision) -> None:
        """Write an input or a decision of the planner."""
        with self._lock:
            plan = self._plan
            if plan is not None:
                self._guarded(lambda _: plan.add(entry))

    def close(self) -> None:
        """Close the files."""
        with self._lock:
            if self._writer is not None:
                self._writer.close()
            if self._moments is not None:
                self._moments.close()
            if self._plan is not None:
                self._plan.close()
            self._writer = self._moments = self._plan = None

    def _note_exits(self, exits: tuple[Exit, ...]) -> None:
        """Write the exits when they change; a flight without exits leaves no file."""
        if exits is not self._exits and (exits or self._exits):
            lines = "".join(_exit_line(exit_) for exit_ in exits)
            self._guarded(lambda _: write_text(self.folder / EXITS, f"{_EXIT_COLUMNS}\n{lines}"))
        self._exits = exits

    def _guarded(self, write: Callable[[FlightWriter], None]) -> None:
        if self.failure is not None or self._writer is None:
            return
        try:
            write(self._writer)
        except (OSError, EdgeSlamError) as error:
            self.failure = OutputError(f"{self.folder}: the recording ended early: {error}")
            logger.warning("%s; the flight goes on", self.failure)


def _exit_line(exit_: Exit) -> str:
    sigmas = (exit_.width_m, exit_.width_sigma_m, exit_.position_sigma_m)
    numbers = (*exit_.centre_w[:2], *exit_.normal_w[:2], *sigmas)
    return ",".join([*(f"{x:.3f}" for x in numbers), str(exit_.places)]) + "\n"


def _line(moment: Moment) -> str:
    state, order = moment.state, moment.order
    command = order.command
    numbers = [*state.p_w, state.yaw_rad, *state.velocity_w, state.position_sigma_m, state.scale_sigma]
    stick = [command.forward_m_s, command.left_m_s, command.up_m_s, command.turn_left_rad_s]
    fields = [
        f"{state.stamp_s:.6f}",
        *(f"{x:.4f}" for x in numbers),
        str(int(state.metric)),
        str(int(state.tracked)),
        f"{state.blind_s:.3f}",
        f"{state.battery:.2f}",
        str(state.revision),
        f"{hull_clearance_m(moment.pilot, state):.3f}",
        str(moment.phase),
        str(order.danger),
        *(f"{x:.3f}" for x in stick),
        command.why.replace(",", ";"),
    ]
    return ",".join(fields) + "\n"
