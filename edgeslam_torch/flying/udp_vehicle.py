"""A Tello over UDP with three threads: perception, planning, and supervision, which alone sends the sticks."""

import logging
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from edgeslam_torch.calibration.camera_choice import choose_camera
from edgeslam_torch.drone.answers import TelloError
from edgeslam_torch.drone.tello import StateMessage, Tello, TelloAddress
from edgeslam_torch.drone.video_stream import OneSize
from edgeslam_torch.errors import SourceError
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.flying.perception.slam_perception import SlamPerception
from edgeslam_torch.flying.recorder import Recorder
from edgeslam_torch.flying.vehicle import TICK_S
from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.types import Frame

logger = logging.getLogger(__name__)

_VIDEO_DELAY_S = 0.35
"""Latency of a Tello's video from exposure to arrival (0.3 to 0.5 s); frames carry no time stamp."""
_FIRST_PICTURE_S = 10.0
_PICTURE_S = 1.0 / 15.0
"""Minimum interval of processed frames; a Tello sends 30 Hz. Two cores also run planner and mapping, and flights in
lockstep are evaluated at 15 Hz."""
_SLOW_S, _SLOW_HZ = 10.0, 5.0
"""Mean rate of processed frames over this time in flight below which a warning is due: at 0.5 m/s and by turns of 30
degrees a second, frames are then 0.1 m and 6 degrees apart, as far as tracking is tested."""
_LAND_S = 60.0
"""Maximum wait for a landing, with the client's repetitions and the descent."""
_THINK_S = 0.5
"""Timeout for a thread to end."""


def too_slow(seen_s: Sequence[float]) -> str:
    """A warning if too few frames were processed; nothing before `_SLOW_S` have passed.

    Args:
        seen_s: Times at which frames in flight were processed [s].
    """
    spent_s = seen_s[-1] - seen_s[0]
    if spent_s < _SLOW_S or len(seen_s) - 1 >= _SLOW_HZ * spent_s:
        return ""
    return (
        f"this computer processes {(len(seen_s) - 1) / spent_s:.1f} pictures a second; below {_SLOW_HZ:g} the map "
        "suffers: close other programs, or see the guide on small computers"
    )


class UdpVehicle:
    """A Tello with perception and flight controller.

    The supervising thread requests an order every `TICK_S` and alone sends ``rc`` and ``land``; it waits neither for
    the planner nor for frames. If it fails, it lands; if the whole program dies, `Guard` lands.

    Args:
        address: Address of the drone.
        flight_controller: Flight controller.
        allow_motion: Whether it may move.
        camera: File or preset of the calibration; the Tello's when None.
        recorder: Receives every frame and state message.

    Raises:
        TelloError: If the drone does not answer, or sends no state or picture.
        CalibrationError: If the calibration is malformed.
    """

    def __init__(
        self,
        address: TelloAddress,
        flight_controller: FlightController,
        allow_motion: bool = False,
        camera: str | Path | None = None,
        seed: int = 0,
        recorder: Recorder | None = None,
    ) -> None:
        self.over = ""
        self._flight_controller = flight_controller
        self._flying = threading.Event()
        self._stopping = threading.Event()
        self._threads: list[threading.Thread] = []
        self._view: View | None = None
        self._view_lock = threading.Lock()
        self._perception: SlamPerception | None = None
        self._recorder = recorder
        self.tello = Tello(address, allow_motion, on_state=self._on_state)
        try:
            self.tello.connect()
            self._video = self.tello.start_video()
            first = self._video.wait(0, _FIRST_PICTURE_S)
            if first is None:
                raise TelloError(f"{address.host}: no picture in {_FIRST_PICTURE_S:.0f} s")
            size = (first.image.shape[1], first.image.shape[0])
            self._one_size = OneSize(size)
            self.camera, self.warnings = choose_camera(size, camera, is_drone=True)
            if recorder is not None:
                recorder.begin(self.camera)
            self._perception = SlamPerception(self.camera, seed, realtime=True)
            assert self.tello.latest is not None  # `connect` waited for it
            self._perception.add_telemetry(self.tello.latest.sample())  # the first map needs an attitude to be level
        except BaseException:
            self.tello.close()
            raise
        for name, work in (("see", self._see), ("plan", self._plan), ("watch", self._watch)):
            self._threads.append(threading.Thread(target=work, name=f"fly-{name}", daemon=True))
            self._threads[-1].start()

    @property
    def flying(self) -> bool:
        """As `Vehicle`."""
        return self._flying.is_set()

    @property
    def battery(self) -> float:
        """As `Vehicle`."""
        latest = self.tello.latest
        return math.nan if latest is None else latest.sample().battery

    def take_off(self) -> None:
        """As `Vehicle`.

        Raises:
            TelloError: If the drone does not take off.
        """
        self.tello.take_off()
        self._flying.set()

    def fly(self, until: Callable[[], bool]) -> None:
        """As `Vehicle`."""
        while self.flying and not until():
            self._stopping.wait(TICK_S)

    def close(self) -> None:
        """As `Vehicle`."""
        try:
            self._flight_controller.land("the program left")
            until_s = self.tello.clock.now() + _LAND_S
            self.fly(lambda: self.tello.clock.now() > until_s)
        finally:
            self._stopping.set()
            self.tello.close()  # also lands, in case the thread above has died
            for thread in self._threads:
                thread.join(_THINK_S)
            if self._perception is not None:
                self._perception.close()

    def _on_state(self, message: StateMessage) -> None:
        if self._perception is not None:
            self._perception.add_telemetry(message.sample())
        if self._recorder is not None:
            self._recorder.state(message)

    def _see(self) -> None:
        """Perception thread: process the newest frame."""
        assert self._perception is not None
        count = 0
        flown_s: list[float] = []
        while not self._stopping.is_set():
            picture = self._video.wait(count, TICK_S)
            if picture is None:
                continue
            count, begin_s = picture.count, self.tello.clock.now()
            try:
                if not self._one_size.fits(picture):
                    continue
            except SourceError as error:
                self._flight_controller.land(str(error))
                continue
            view = self._perception.seen(picture.image, picture.stamp_s, picture.stamp_s - _VIDEO_DELAY_S)
            if view is not None:
                with self._view_lock:
                    self._view = view
            if self.flying and (not flown_s or flown_s[-1] - flown_s[0] < _SLOW_S):
                flown_s.append(self.tello.clock.now())
                if warning := too_slow(flown_s):
                    logger.warning(warning)
            if self._recorder is not None:
                self._recorder.picture(Frame(picture.count - 1, picture.stamp_s, picture.image))
            self._stopping.wait(max(0.0, begin_s + _PICTURE_S - self.tello.clock.now()))

    def _plan(self) -> None:
        """Planning thread: compute a command for the newest state."""
        assert self._perception is not None
        while not self._stopping.wait(TICK_S):
            if not self.flying:
                continue
            with self._view_lock:
                view, self._view = self._view, None
            self._flight_controller.plan(self._perception.state(self.tello.clock.now(), view))

    def _watch(self) -> None:
        """Supervising thread: send orders; any failure ends with a landing."""
        while not self._stopping.wait(TICK_S):
            if not self.flying:
                continue
            try:
                self._tick()
            except TelloError as error:  # a guard of the client lands, e.g. on lost state messages
                self._end(self.tello.stop_reason or str(error))
            except Exception as error:
                logger.exception("the supervisor failed; landing")
                self._end(f"the supervisor failed: {error}")

    def _tick(self) -> None:
        assert self._perception is not None
        order = self._flight_controller.order(self._perception.state(self.tello.clock.now()))
        if order.land:
            self._end(order.command.why)
        else:
            self.tello.rc(*order.command.sticks())

    def _end(self, why: str) -> None:
        self.over = why
        try:
            self.tello.land()
        except TelloError as error:
            self.over = f"{why}; {error}"
        finally:
            self._flying.clear()
