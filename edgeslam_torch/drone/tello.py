"""Client for a DJI Tello over its text SDK (1.3 and 2.0): commands, state, video, and safe landing."""

import contextlib
import logging
import math
import os
import queue
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass

from edgeslam_torch.drone.address import TelloAddress
from edgeslam_torch.drone.answers import NoAnswer, TelloError, belongs_to, is_refusal
from edgeslam_torch.drone.guard import Guard
from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.drone.sticks import Sticks
from edgeslam_torch.drone.udp import Inlet, told
from edgeslam_torch.drone.video_stream import ArrivalClock, Picture, VideoReceiver
from edgeslam_torch.errors import SourceError
from edgeslam_torch.types import TelemetrySample

logger = logging.getLogger(__name__)

_STEPS = ("up", "down", "left", "right", "forward", "back", "cw", "ccw", "go", "curve", "flip", "jump")
_MOVES = frozenset(["takeoff", "throwfly", *_STEPS, "rc", "motoron", "speed", "stop"])
"""Commands that move the drone or change how it moves."""
_NEVER_TWICE = _MOVES - {"stop", "speed", "rc", "takeoff"}
"""Commands that are not repeated: the answer may be lost although the drone received the command, and it would move
twice."""
_MOVE_TIMEOUT_S = 20.0
_CLIMB_TIMEOUT_S = 20.0
_RISE_TIMEOUT_S = 6.0
_LAND_TRIES, _LAND_AGAIN_S = 10, 2.0
_PARTING = ("land", "streamoff")
"""Commands still allowed after a flight has ended."""
_FRESH_S = 1.0
"""Maximum age of state messages."""
_RISEN_CM = 20.0
_QUIET_S = 1.5
"""Time without state or frames after which they are requested again; a restarted drone sends neither."""
_ASK_S = 1.0
"""Time between two such requests."""
_ASK_ANSWER_S = 0.3
"""Wait for an answer to one, short against the times of `TelloLimits` that end a flight."""
_STEADY_CM = 6.0
_STEADY_S = 1.5


@dataclass(frozen=True, slots=True)
class TelloLimits:
    """Timeouts and conditions that end a flight."""

    timeout_s: float = 3.0
    retries: int = 3
    keep_alive_s: float = 5.0
    """Keep-alive interval; a Tello lands after 15 s without a command."""
    min_battery: float = 0.10
    max_temperature_c: float = 95.0
    state_loss_s: float = 5.0
    """Land after this time without state in flight."""
    video_loss_s: float = 5.0
    """Land after this time without a picture in flight, once the stream was requested."""

    def __post_init__(self) -> None:
        if min(self.timeout_s, self.keep_alive_s, self.state_loss_s, self.video_loss_s) <= 0 or self.retries < 0:
            raise ValueError(f"times must be positive and retries not negative: {self}")


@dataclass(frozen=True, slots=True)
class StateMessage:
    """One state packet."""

    stamp_s: float
    """Arrival."""
    raw: str
    fields: dict[str, float | str]

    def sample(self) -> TelemetrySample:
        """In SI units and our axes."""
        return sample_from_sdk(self.stamp_s, self.fields)


class Tello:
    """One drone. Use it as a context manager: leaving it always lands a drone that took off with it.

    A `Guard` lands it when this program dies or hangs in flight, `Sticks` centre the sticks when no fresh ``rc`` comes,
    and packets of other senders are ignored.
    No motion command is sent unless ``allow_motion`` is true.

    Args:
        address: Where it is.
        allow_motion: Whether motion commands are allowed (``--fly`` on the command line).
        limits: Timeouts and guards.
        on_state: Called for each state message, from the receiving thread.
        on_picture: Called for each picture, from the video thread.
    """

    def __init__(
        self,
        address: TelloAddress | None = None,
        allow_motion: bool = False,
        limits: TelloLimits | None = None,
        on_state: Callable[[StateMessage], None] | None = None,
        on_picture: Callable[[Picture], None] | None = None,
    ) -> None:
        self.address = address or TelloAddress()
        self.allow_motion = allow_motion
        self.limits = limits or TelloLimits()
        self.clock = ArrivalClock()
        self.stop_reason = ""
        """Reason why a guard ended the flight; empty otherwise."""
        self.latest: StateMessage | None = None
        self.malformed = 0
        """State packets without a single readable field."""
        self.silences = 0
        """How often state came again after a silence: a restart, or no Wi-Fi for a while."""
        self._on_state, self._on_picture = on_state, on_picture
        self._replies: queue.Queue[str] = queue.Queue()
        self._sending = threading.RLock()
        self.airborne = False
        """Whether this client has taken off and not landed."""
        self._landing = threading.Event()
        """Set while landing: no other command is sent or waited for."""
        self._leaving = threading.Event()
        """The same permanently after `close`: a pending take-off is not sent."""
        self._stopping = threading.Event()
        self._closed = threading.Event()
        self._last_sent_s = self._last_asked_s = -math.inf
        self._flight_begin_s = math.inf
        self._took_off_s = -math.inf
        """When the last take-off was sent."""
        self._ground: float | None = None
        """Height [cm] before take-off."""
        self._rose = False
        """Whether the climb of this flight was seen in the state."""
        self._guard: Guard | None = None
        self._video: VideoReceiver | None = None
        self._video_begin_s = math.inf
        self._host, self._local = self.address.ends()
        self._commands = Inlet((self._local, 0), "command", self._host)
        try:
            self._states = Inlet((self._local, self.address.state_port), "state", self._host)
        except SourceError:
            self._commands.close()
            raise
        self._sticks = Sticks(self._transmit, self._beat)
        self._threads = [
            threading.Thread(target=self._receive_replies, name="tello-replies", daemon=True),
            threading.Thread(target=self._receive_states, name="tello-state", daemon=True),
            threading.Thread(target=self._watch, name="tello-watch", daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        threading.Thread(target=self._close, name="tello-close", daemon=True).start()

    # --- session -------------------------------------------------------------------------------------------------

    def connect(self, state_timeout_s: float = 3.0) -> None:
        """Enter SDK mode and wait for the first state message.

        Raises:
            TelloError: If the drone does not answer or sends no state.
        """
        self.send("command")
        begin = self.clock.now()
        while self.latest is None:
            if self.clock.now() - begin > state_timeout_s or self._stopping.wait(0.02):
                raise TelloError(
                    f"{self.address.host}: answers commands but sends no state to port {self.address.state_port}; "
                    "is a firewall in between?"
                )

    def __enter__(self) -> "Tello":
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    def close(self) -> None:
        """Land if airborne, stop the video, close the sockets; never raises for a drone that is gone.

        Ctrl-C meanwhile does not end the landing: it is raised when that is over.
        """
        interrupted = False
        while not self._closed.is_set():
            try:
                self._leaving.set()
                self._closed.wait(0.2)
            except KeyboardInterrupt:
                interrupted = True
        if interrupted:
            raise KeyboardInterrupt

    def _close(self) -> None:
        """The work of `close`, in a thread that Ctrl-C does not reach."""
        self._leaving.wait()
        failure = ""
        try:
            with self._sending:
                airborne = self.airborne
            if airborne:
                self.land()
            elif self._video is not None:
                self.send("streamoff", retries=0, timeout_s=0.5)
        except TelloError as error:
            failure = str(error)
        finally:
            try:
                self._hang_up()
                if failure:  # logged at the end: a stopped terminal would block it
                    logger.warning("while closing: %s", failure)
            finally:
                self._closed.set()

    def _hang_up(self) -> None:
        """End the threads and release the ports; a guard that may still be needed continues alone."""
        self._stopping.set()
        self._sticks.stop()
        if self._guard is not None:
            self._guard.dismiss(landed=False)
        if self._video is not None:
            self._video.stop()
        for inlet in (self._commands, self._states):
            inlet.stop()
        for thread in self._threads:
            thread.join(timeout=1.0)
        self._commands.close()
        self._states.close()

    # --- commands ------------------------------------------------------------------------------------------------

    def send(self, command: str, timeout_s: float | None = None, retries: int | None = None) -> str:
        """Send one command and return the answer.

        A motion command is sent once: only its answer may have been lost.

        Raises:
            TelloError: If there is no answer, the drone answers with an error, or motion is not allowed.
        """
        name = command.split(maxsplit=1)[0] if command.strip() else ""
        if not command.isascii() or not command.isprintable() or not name:
            raise TelloError(f"not an SDK command: {command!r}")
        self._check_motion(name)
        if name == "rc":
            self._sticks.push(command, lambda: self._check_motion(name))
            return ""
        if name == "takeoff":
            self.take_off()
            return "ok"
        moving = name in _NEVER_TWICE
        tries = 1 if moving else 1 + (self.limits.retries if retries is None else retries)
        wait = timeout_s or (_MOVE_TIMEOUT_S if moving else self.limits.timeout_s)
        with self._sending:
            for _ in range(tries):
                self._check_motion(name)  # a landing may have begun while we waited for our turn
                if name == "throwfly":
                    self._begin_flight()
                if moving or name == "stop":
                    self._sticks.let_go()
                self._drop_old_replies()
                self._transmit(command)
                answer = self._answer(command, wait)
                if answer is None:
                    continue
                if is_refusal(answer):
                    raise TelloError(f"{self.address.host}: {command!r} was refused: {answer}")
                return answer
        self._check_motion(name)
        raise NoAnswer(
            f"{self.address.host}: no answer to {command!r} in {tries} x {wait:.0f} s; "
            "is the drone on and this computer in its Wi-Fi?"
        )

    def query(self, name: str) -> float:
        """Number in the answer to a query (``battery?``), without its unit.

        Raises:
            TelloError: If there is no number in the answer.
        """
        answer = self.send(name)
        match = re.match(r"\s*(-?\d+(?:\.\d+)?)", answer)
        if match is None:
            raise TelloError(f"{self.address.host}: {name} was answered with {answer[:40]!r}")
        return float(match.group(1))

    def take_off(self) -> None:
        """Take off and wait until the climb is over.

        Unlike a movement, the command is repeated when it has no effect: a flying drone refuses it. A climb seen in
        the state counts as an answer.

        Raises:
            TelloError: If motion is not allowed, the battery is low, the drone refuses, or it does not answer.
        """
        self._check_motion("takeoff")
        if reason := self._unfit():
            raise TelloError(f"{self.address.host}: not taking off: {reason}")
        with self._sending:
            self._begin_flight()
            self._sticks.let_go()
            self._drop_old_replies()
            tries = 1 + self.limits.retries
            for attempt in range(tries):
                self._check_motion("takeoff")
                self._took_off_s = self.clock.now()
                self._transmit("takeoff")
                answer = self._answer("takeoff", self.limits.timeout_s, self._risen)
                if answer is not None and not is_refusal(answer):
                    return
                if self._risen():
                    break
                if answer is not None and attempt == 0:
                    self._end_flight()
                    raise TelloError(f"{self.address.host}: 'takeoff' was refused: {answer}")
                if answer is not None:
                    break  # a refusal of what is repeated: it received the command before and is about to rise
            self._wait_for_hover()

    def land(self) -> None:
        """Land, repeating the command until confirmed. Other waits are aborted.

        Raises:
            TelloError: If the drone neither answers nor says that it is on the ground.
        """
        self._landing.set()
        self._sticks.let_go()
        if not self._sending.acquire(blocking=False):
            self._transmit("land")  # at once, while another thread still waits for the answer to a long move
            self._sending.acquire()
        try:
            self._land_until_down()
        finally:
            self._sending.release()
            self._landing.clear()

    def _land_until_down(self) -> None:
        agreed = 0
        for _ in range(_LAND_TRIES):
            self._drop_old_replies()
            self._transmit("land")
            answer = self._answer("land", _LAND_AGAIN_S, self._landed)
            agreed += answer is not None and not is_refusal(answer)
            deadline = self.clock.now() + (0.0 if answer is None else 1.0)
            while not self._landed() and self.clock.now() < deadline and not self._stopping.wait(0.05):
                pass  # the answer shows in the state a moment later
            # The first "ok" may answer the movement that the landing interrupted.
            if self._landed() or agreed > 1 or (agreed and self._level() is None):
                self._end_flight()
                return
        raise TelloError(f"{self.address.host}: no answer to 'land'; the drone lands by itself after 15 s of silence")

    def rc(self, right: float, forward: float, up: float, clockwise: float) -> None:
        """Sticks in [-1, 1]. Send it at least every 0.3 s: sticks that are older are centred (`Sticks`).

        Raises:
            TelloError: If motion is not allowed.
        """
        sticks = (max(-1.0, min(1.0, s)) if math.isfinite(s) else 0.0 for s in (right, forward, up, clockwise))
        self.send("rc " + " ".join(f"{round(100 * s)}" for s in sticks))

    def move(self, forward_m: float, left_m: float, up_m: float, speed_m_s: float = 0.4) -> None:
        """Fly by a vector in body axes and wait until it is done.

        Raises:
            TelloError: As `send`.
        """
        self.send("go " + " ".join(f"{round(100 * x)}" for x in (forward_m, left_m, up_m, speed_m_s)))

    def turn(self, left_rad: float) -> None:
        """Turn on the spot, counter-clockwise positive, and wait until it is done.

        Raises:
            TelloError: As `send`.
        """
        degrees = round(math.degrees(abs(left_rad)))
        if degrees:
            self.send(f"{'ccw' if left_rad > 0 else 'cw'} {degrees}")

    def start_video(self) -> VideoReceiver:
        """Ask for the stream and receive it.

        Raises:
            TelloError: If the drone refuses.
            SourceError: If PyAV is missing or the port is taken.
        """
        if self._video is None:
            local = (self._local, self.address.video_port)
            self._video = VideoReceiver(local, self.clock, self._host, self._on_picture)
        self.send("streamon")
        self._video_begin_s = self.clock.now()
        return self._video

    @property
    def refused(self) -> dict[str, int]:
        """Packets of other senders that were ignored, per channel."""
        video = 0 if self._video is None else self._video.refused
        return {"video": video, "state": self._states.refused, "answers": self._commands.refused}

    # --- inside --------------------------------------------------------------------------------------------------

    def _check_motion(self, name: str) -> None:
        if name in _MOVES and self.stop_reason:
            raise TelloError(f"{self.address.host}: {name!r} not sent: the flight has ended: {self.stop_reason}")
        if name in _MOVES and self._over():
            raise TelloError(f"{self.address.host}: {name!r} not sent: landing")
        if name in _MOVES and not self.allow_motion:
            raise TelloError(f"{name!r} would move the drone; pass --fly (allow_motion=True) to let it")

    def _over(self) -> bool:
        return self._landing.is_set() or self._leaving.is_set()

    def _begin_flight(self) -> None:
        """From here on the drone may be in the air, even without an answer."""
        self._ground, self._rose = self._level(), False
        self._took_off_s = self._flight_begin_s = self.clock.now()
        if self._guard is None and os.name == "posix":
            try:
                self._guard = Guard(self._commands.socket, (self._host, self.address.command_port))
            except OSError as error:
                logger.warning("no guard against the death of this program (%s); the drone then lands by itself", error)
        self.airborne = True

    def _end_flight(self) -> None:
        self.airborne = False
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.dismiss(landed=True)

    def _beat(self, pushed: bool) -> None:
        if (guard := self._guard) is not None:
            guard.beat(pushed)

    def _transmit(self, command: str) -> None:
        try:
            self._commands.socket.sendto(command.encode("ascii"), (self._host, self.address.command_port))
        except OSError as error:  # no network at the moment; what matters is sent again
            logger.debug("%s: %r not sent: %s", self.address.host, command, error)
        self._last_sent_s = self.clock.now()

    def _drop_old_replies(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._replies.get_nowait()

    def _answer(self, command: str, timeout_s: float, enough: Callable[[], bool] = lambda: False) -> str | None:
        """The answer to a command; None on timeout, on a requested landing, or when its effect is observed."""
        deadline = self.clock.now() + timeout_s
        while not self._stopping.is_set() and (command in _PARTING or not self._over()):
            left = deadline - self.clock.now()
            if left <= 0 or enough():
                return None
            try:
                answer = self._replies.get(timeout=min(left, 0.1))
            except queue.Empty:
                continue
            if belongs_to(command, answer):
                return answer
        return None

    def _wait_for_hover(self) -> None:
        """Until 'takeoff' is answered, or the drone has risen and its height no longer changes.

        Raises:
            TelloError: If it does not rise.
        """
        begin = since = self.clock.now()
        level = self._level()
        while self.clock.now() - begin < (_CLIMB_TIMEOUT_S if self._risen() else _RISE_TIMEOUT_S):
            self._check_motion("takeoff")
            answer = self._answer("takeoff", 0.1)
            if answer is not None and not is_refusal(answer):
                return
            now, height = self.clock.now(), self._level()
            if height is None or level is None or abs(height - level) > _STEADY_CM:
                level, since = height, now
            elif now - since > _STEADY_S and self._risen():
                return
        if not self._risen():
            raise TelloError(f"{self.address.host}: no answer to 'takeoff' and no climb seen")

    def _receive_replies(self) -> None:
        for packet in self._commands.packets():
            text = packet.decode("ascii", errors="replace").strip("\x00 \r\n")
            if text and text.isascii() and text.isprintable() and len(text) < 200:
                self._replies.put(text)

    def _receive_states(self) -> None:
        for packet in self._states.packets():
            stamp = self.clock.now()
            fields = parse_state(packet)
            if "bat" not in fields and "pitch" not in fields:
                self.malformed += 1
                continue
            self.silences += self.latest is not None and stamp - self.latest.stamp_s > _QUIET_S
            message = StateMessage(stamp, packet.decode("ascii", errors="replace").strip(), fields)
            self.latest = message
            self._rose |= self.airborne and self._risen()
            self._on_state = told(self._on_state, message)

    def _fresh(self) -> dict[str, float | str]:
        """Fields of the last state message; none when it is old."""
        latest = self.latest
        return latest.fields if latest is not None and self.clock.now() - latest.stamp_s < _FRESH_S else {}

    def _level(self) -> float | None:
        """Height [cm] by range sensor, else by the drone's own estimate, from fresh state."""
        fields = self._fresh()
        tof, h = fields.get("tof"), fields.get("h")
        if isinstance(tof, float) and 0 < tof < 800:
            return tof
        return h if isinstance(h, float) else None

    def _risen(self) -> bool:
        """Whether the drone is higher than it was on the ground."""
        level = self._level()
        return level is not None and level > (10.0 if self._ground is None else self._ground) + _RISEN_CM

    def _landed(self) -> bool:
        """Whether the drone has landed for good; after a take-off command it may be about to rise."""
        came_down = self._rose or self.clock.now() - self._took_off_s > _RISE_TIMEOUT_S
        return came_down and self._grounded()

    def _grounded(self) -> bool:
        """Whether fresh state says that the drone stands on the floor."""
        fields = self._fresh()
        tof, h = fields.get("tof"), fields.get("h")
        low = isinstance(tof, float) and tof <= 15 and isinstance(h, float) and h <= 10
        return low and fields.get("vgz", 0.0) == 0.0  # not while it still sinks

    def _unfit(self) -> str:
        """Reason why this drone should not fly; empty if it may."""
        fields = self.latest.fields if self.latest is not None else {}
        battery, heat = fields.get("bat"), fields.get("temph")
        if isinstance(battery, float) and battery < 100 * self.limits.min_battery:
            return f"battery at {battery:.0f} %"
        if isinstance(heat, float) and heat > self.limits.max_temperature_c:
            return f"temperature {heat:.0f} C"
        return ""

    def _watch(self) -> None:
        """Send keep-alives; end the flight when the state requires it, repeating the landing until down."""
        while not self._stopping.wait(0.1):
            now = self.clock.now()
            reason = self.stop_reason or self._why_land(now)
            if self.airborne and reason and not self._leaving.is_set():
                self.stop_reason = reason
                self._land_because(reason)
            elif missing := self._missing(now):
                # Entering SDK mode and asking for video again is harmless for a drone in flight.
                if now - self._last_asked_s > _ASK_S and self._sent_in_passing(missing, _ASK_ANSWER_S):
                    self._last_asked_s = now
            elif now - self._last_sent_s > self.limits.keep_alive_s and math.isfinite(self._last_sent_s):
                self._sent_in_passing(["battery?"], 1.0)

    def _land_because(self, reason: str) -> None:
        try:
            self.land()  # logged afterwards: a stopped terminal would delay it
            logger.warning("%s: landed: %s", self.address.host, reason)
        except TelloError as error:
            logger.error("%s", error)

    def _why_land(self, now: float) -> str:
        state_s = self.latest.stamp_s if self.latest is not None else self._flight_begin_s
        if now - max(state_s, self._flight_begin_s) > self.limits.state_loss_s:
            return f"no state for {self.limits.state_loss_s:.0f} s"
        if now - max(self._pictured_s(), self._flight_begin_s) > self.limits.video_loss_s:
            return f"no video for {self.limits.video_loss_s:.0f} s"
        if self._rose and self._grounded() and not self._over():
            return "the drone came down by itself"
        return self._unfit()

    def _pictured_s(self) -> float:
        """Arrival of the newest frame, or the first request for video; infinite before that."""
        newest = self._video.newest if self._video is not None else None
        return max(newest.stamp_s if newest is not None else 0.0, self._video_begin_s)

    def _missing(self, now: float) -> list[str]:
        """Commands that restart state messages or video that have stopped."""
        if self.latest is None:
            return []
        words = ["command"] if now - self.latest.stamp_s > _QUIET_S else []
        return [*words, "streamon"] if now - self._pictured_s() > _QUIET_S else words

    def _sent_in_passing(self, commands: list[str], timeout_s: float) -> bool:
        """Send commands whose answers do not matter, unless another thread is talking to the drone anyway."""
        if not self._sending.acquire(blocking=False):
            return False
        try:
            for command in commands:
                self.send(command, timeout_s=timeout_s, retries=0)
        except TelloError:
            logger.debug("%s: no answer yet", self.address.host)
        finally:
            self._sending.release()
        return True
