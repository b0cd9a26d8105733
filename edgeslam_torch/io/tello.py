"""Client for a DJI Tello over its text SDK (1.3 and 2.0): commands, state, video, and the will to land."""

import ipaddress
import logging
import math
import queue
import re
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from urllib.parse import urlsplit

from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.io.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.io.tello_answers import belongs_to, is_refusal
from edgeslam_torch.io.tello_video import ArrivalClock, Picture, VideoReceiver, open_udp
from edgeslam_torch.types import TelemetrySample

logger = logging.getLogger(__name__)

TELLO_HOST = "192.168.10.1"
_STEPS = ("up", "down", "left", "right", "forward", "back", "cw", "ccw", "go", "curve", "flip", "jump")
_MOVES = frozenset(["takeoff", "throwfly", *_STEPS, "rc", "motoron", "speed", "stop"])
"""Commands that make a drone move, or change how it moves."""
_NEVER_TWICE = _MOVES - {"stop", "speed", "rc", "takeoff"}
"""A lost answer does not mean that the drone did not hear: sent again, the drone would move twice."""
_MOVE_TIMEOUT_S = 20.0
_CLIMB_TIMEOUT_S = 20.0
_RISE_TIMEOUT_S = 6.0
_LAND_TRIES, _LAND_AGAIN_S = 10, 2.0
_PARTING = ("land", "streamoff")
"""What is still sent and waited for when the flight is over."""
_FRESH_S = 1.0
"""State older than this says nothing of the present."""
_RISEN_CM = 20.0
_STEADY_CM = 6.0
_STEADY_S = 1.5


class TelloError(EdgeSlamError):
    """The drone does not answer, refuses, or may not do what was asked."""


class NoAnswer(TelloError):
    """A command was sent and nothing came back: it may have been heard or not."""


@dataclass(frozen=True, slots=True)
class TelloAddress:
    """Where a drone and our ends of its three channels are."""

    host: str = TELLO_HOST
    command_port: int = 8889
    state_port: int = 8890
    video_port: int = 11111
    bind: str | None = None
    """Our address; ``None`` takes the interface that leads to the drone, so loopback stays on loopback."""

    @classmethod
    def parse(cls, text: str) -> "TelloAddress":
        """From ``tello://HOST[:COMMAND[:STATE[:VIDEO]]]`` or ``HOST``; no host means 192.168.10.1.

        Raises:
            SourceError: If it is no such address.

        Example:
            >>> TelloAddress.parse("tello://127.0.0.1:9000:9001:9002").video_port
            9002
        """
        body = text.removeprefix("tello://").rstrip("/")
        host, *ports = body.split(":") if body else [TELLO_HOST]
        if (
            len(ports) > 3
            or not re.fullmatch(r"[A-Za-z0-9._-]*", host)
            or urlsplit(f"//{host}").hostname != (host.lower() or None)
        ):
            raise SourceError(f"{text}: not a drone's address; give tello://HOST[:COMMAND[:STATE[:VIDEO]]]")
        numbers = []
        for port in ports:
            if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
                raise SourceError(f"{text}: port {port!r} is not a number from 1 to 65535")
            numbers.append(int(port))
        defaults = [8889, 8890, 11111]
        command, state, video = numbers + defaults[len(numbers) :]
        return cls(host or TELLO_HOST, command, state, video)

    def local(self) -> str:
        """Our address towards the drone.

        Raises:
            TelloError: If there is no way to the drone.
        """
        if self.bind is not None:
            return self.bind
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.connect((self.host, self.command_port))  # sends nothing
                return str(probe.getsockname()[0])
        except OSError as error:
            raise TelloError(
                f"{self.host}: no way there ({error.strerror or error}); join the drone's Wi-Fi (TELLO-XXXXXX) first"
            ) from error


@dataclass(frozen=True, slots=True)
class TelloLimits:
    """Timeouts and the conditions under which a flight ends by itself."""

    timeout_s: float = 3.0
    retries: int = 3
    keep_alive_s: float = 5.0
    """A Tello lands by itself after 15 s without a command."""
    min_battery: float = 0.10
    max_temperature_c: float = 95.0
    state_loss_s: float = 5.0
    """Without state for so long in flight: land."""
    video_loss_s: float = 5.0
    """Without a picture for so long in flight, once the stream has been asked for: land."""

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
    """One drone. Use it as a context manager: leaving it for whatever reason lands a drone that took off with it.

    Nothing that makes the drone move is sent unless ``allow_motion`` is true.

    Args:
        address: Where it is.
        allow_motion: Whether motion commands are let through (``--fly`` on the command line).
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
        """Why a guard ended the flight; empty while none did."""
        self.latest: StateMessage | None = None
        self.malformed = 0
        """State packets without a single readable field."""
        self._on_state, self._on_picture = on_state, on_picture
        self._replies: queue.Queue[str] = queue.Queue()
        self._sending = threading.RLock()
        self._airborne = False
        self._landing = threading.Event()
        """Set while a landing is wanted: nothing else is waited for, nothing else is sent."""
        self._leaving = threading.Event()
        """The same for good, once `close` was called."""
        self._stopping = threading.Event()
        self._last_sent_s = -math.inf
        self._flight_begin_s = math.inf
        self._events: deque[str] = deque(maxlen=100)
        self._video: VideoReceiver | None = None
        self._video_begin_s = math.inf
        local = self.address.local()
        self._command_socket = open_udp((local, 0), "command")
        try:
            self._state_socket = open_udp((local, self.address.state_port), "state")
        except SourceError:
            self._command_socket.close()
            raise
        self._threads = [
            threading.Thread(target=self._receive_replies, name="tello-replies", daemon=True),
            threading.Thread(target=self._receive_states, name="tello-state", daemon=True),
            threading.Thread(target=self._watch, name="tello-watch", daemon=True),
        ]
        for udp in (self._command_socket, self._state_socket):
            udp.settimeout(0.2)
        for thread in self._threads:
            thread.start()

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Land if airborne, stop the video, close the sockets; never raises for a drone that is gone."""
        if self._stopping.is_set():
            return
        self._leaving.set()  # a take-off that another thread was about to send stays unsent
        try:
            with self._sending:
                airborne = self._airborne
            if airborne:
                self.land()
            elif self._video is not None:
                self.send("streamoff", retries=0, timeout_s=0.5)
        except TelloError as failure:
            logger.warning("while closing: %s", failure)
        finally:
            self._stopping.set()
            if self._video is not None:
                self._video.stop()
            for thread in self._threads:
                thread.join(timeout=1.0)
            self._command_socket.close()
            self._state_socket.close()

    # --- commands ------------------------------------------------------------------------------------------------

    def send(self, command: str, timeout_s: float | None = None, retries: int | None = None) -> str:
        """Send one command and return the answer.

        A command that moves the drone is sent once: its answer may be lost, not the command.

        Raises:
            TelloError: If there is no answer, the drone answers with an error, or motion is not allowed.
        """
        name = command.split(maxsplit=1)[0] if command.strip() else ""
        if not command.isascii() or not command.isprintable() or not name:
            raise TelloError(f"not an SDK command: {command!r}")
        self._check_motion(name)
        if name == "rc":
            self._transmit(command)
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
                self._airborne |= name == "throwfly"
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
        """Number that a read command (``battery?``) answers, without its unit.

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

        Unlike a movement the command is sent again when nothing comes of it: a drone in the air refuses it. The climb
        itself, seen in the state, is as good as an answer.

        Raises:
            TelloError: If motion is not allowed, the battery is low, the drone refuses, or nothing is heard of it.
        """
        self._check_motion("takeoff")
        reason = self._unfit()
        if reason:
            raise TelloError(f"{self.address.host}: not taking off: {reason}")
        with self._sending:
            ground = self._level()
            # Set before the answer: from here on the drone may be in the air, whatever is heard of it.
            self._airborne, self._flight_begin_s = True, self.clock.now()
            self._drop_old_replies()
            tries = 1 + self.limits.retries
            for attempt in range(tries):
                self._check_motion("takeoff")
                self._transmit("takeoff")
                answer = self._answer("takeoff", self.limits.timeout_s, lambda: self._risen(ground))
                if answer is not None and not is_refusal(answer):
                    return
                if self._risen(ground):
                    break
                if answer is not None and attempt == 0:
                    self._airborne = False
                    raise TelloError(f"{self.address.host}: 'takeoff' was refused: {answer}")
                if answer is not None:
                    break  # a refusal of what is repeated: it heard us before and is about to rise
            self._wait_for_hover(ground)

    def land(self) -> None:
        """Land, insistently: an answer may be lost, a drone in the air may not. Whatever else is waited for ends.

        Raises:
            TelloError: If the drone neither answers nor says that it is on the ground.
        """
        self._landing.set()
        self._transmit("rc 0 0 0 0")
        try:
            with self._sending:
                agreed = 0
                for _ in range(_LAND_TRIES):
                    self._drop_old_replies()
                    self._transmit("land")
                    answer = self._answer("land", _LAND_AGAIN_S, self._grounded)
                    agreed += answer is not None and not is_refusal(answer)
                    deadline = self.clock.now() + (0.0 if answer is None else 1.0)
                    while not self._grounded() and self.clock.now() < deadline and not self._stopping.wait(0.05):
                        pass  # what was answered shows in the state a moment later
                    # The first "ok" may be that of the movement which the landing ended.
                    if self._grounded() or agreed > 1 or (agreed and self._level() is None):
                        self._airborne = False
                        return
        finally:
            self._landing.clear()
        raise TelloError(f"{self.address.host}: no answer to 'land'; the drone lands by itself after 15 s of silence")

    def rc(self, right: float, forward: float, up: float, clockwise: float) -> None:
        """Sticks in [-1, 1]; not answered, so send it again and again.

        Raises:
            TelloError: If motion is not allowed.
        """
        sticks = [
            round(100 * max(-1.0, min(1.0, s if math.isfinite(s) else 0.0))) for s in (right, forward, up, clockwise)
        ]
        self.send("rc " + " ".join(str(s) for s in sticks))

    def move(self, forward_m: float, left_m: float, up_m: float, speed_m_s: float = 0.4) -> None:
        """Fly by a vector in body axes and wait until it is done.

        Raises:
            TelloError: As `send`.
        """
        cm = [round(100 * x) for x in (forward_m, left_m, up_m)]
        self.send(f"go {cm[0]} {cm[1]} {cm[2]} {round(100 * speed_m_s)}")

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
            local = (self.address.local(), self.address.video_port)
            self._video = VideoReceiver(local, self.clock, self._on_picture)
        self.send("streamon")
        self._video_begin_s = self.clock.now()
        return self._video

    @property
    def airborne(self) -> bool:
        """Whether this client has taken off and not landed."""
        return self._airborne

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

    def _transmit(self, command: str) -> None:
        try:
            self._command_socket.sendto(command.encode("ascii"), (self.address.host, self.address.command_port))
        except OSError as error:
            if not self._stopping.is_set():
                logger.warning("%s: %r not sent: %s", self.address.host, command, error)
        self._last_sent_s = self.clock.now()

    def _drop_old_replies(self) -> None:
        while True:
            try:
                self._replies.get_nowait()
            except queue.Empty:
                return

    def _answer(self, command: str, timeout_s: float, enough: Callable[[], bool] = lambda: False) -> str | None:
        """The answer to a command; None when time is up, a landing is wanted, or what it should bring is seen."""
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

    def _wait_for_hover(self, ground: float | None) -> None:
        """Until 'takeoff' is answered, or the drone has risen and its height no longer changes.

        Raises:
            TelloError: If it does not rise.
        """
        begin = since = self.clock.now()
        level = self._level()
        while self.clock.now() - begin < (_CLIMB_TIMEOUT_S if self._risen(ground) else _RISE_TIMEOUT_S):
            self._check_motion("takeoff")
            answer = self._answer("takeoff", 0.1)
            if answer is not None and not is_refusal(answer):
                return
            now, height = self.clock.now(), self._level()
            if height is None or level is None or abs(height - level) > _STEADY_CM:
                level, since = height, now
            elif now - since > _STEADY_S and self._risen(ground):
                return
        if not self._risen(ground):
            raise TelloError(f"{self.address.host}: no answer to 'takeoff' and no climb seen")

    def _receive_replies(self) -> None:
        for packet, sender in self._packets(self._command_socket):
            if not self._is_drone(sender):
                continue
            text = packet.decode("ascii", errors="replace").strip("\x00 \r\n")
            if text and text.isascii() and text.isprintable() and len(text) < 200:
                self._replies.put(text)

    def _receive_states(self) -> None:
        for packet, sender in self._packets(self._state_socket):
            if not self._is_drone(sender):
                continue
            stamp = self.clock.now()
            fields = parse_state(packet)
            if "bat" not in fields and "pitch" not in fields:
                self.malformed += 1
                continue
            message = StateMessage(stamp, packet.decode("ascii", errors="replace").strip(), fields)
            self.latest = message
            if self._on_state is not None:
                self._on_state(message)

    def _packets(self, udp: socket.socket):  # type: ignore[no-untyped-def]
        while not self._stopping.is_set():
            try:
                yield udp.recvfrom(4096)
            except TimeoutError:
                continue
            except ConnectionError:
                continue  # an ICMP "port unreachable" of an earlier packet
            except OSError:
                return  # closed

    def _is_drone(self, sender: tuple[str, int]) -> bool:
        try:
            return sender[0] == self.address.host or not ipaddress.ip_address(self.address.host)
        except ValueError:
            return True  # the drone was given by name

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

    def _risen(self, ground: float | None) -> bool:
        """Whether the drone is higher than it was on the ground."""
        level = self._level()
        return level is not None and level > (10.0 if ground is None else ground) + _RISEN_CM

    def _grounded(self) -> bool:
        """Whether fresh state says that the drone stands on the floor."""
        fields = self._fresh()
        tof, h = fields.get("tof"), fields.get("h")
        low = isinstance(tof, float) and tof <= 15 and isinstance(h, float) and h <= 10
        return low and fields.get("vgz", 0.0) == 0.0  # not while it still sinks

    def _unfit(self) -> str:
        """Why this drone should not fly; empty when it may."""
        fields = self.latest.fields if self.latest is not None else {}
        battery, heat = fields.get("bat"), fields.get("temph")
        if isinstance(battery, float) and battery < 100 * self.limits.min_battery:
            return f"battery at {battery:.0f} %"
        if isinstance(heat, float) and heat > self.limits.max_temperature_c:
            return f"temperature {heat:.0f} C"
        return ""

    def _watch(self) -> None:
        """Keep the drone listening; end the flight when its state says so."""
        while not self._stopping.wait(0.1):
            now = self.clock.now()
            reason = self._why_land(now) if self._airborne else ""
            if reason and not self.stop_reason:
                self.stop_reason = reason
                logger.warning("%s: landing: %s", self.address.host, reason)
                self._transmit("land")  # at once, even while another thread waits for the answer to a long move
                try:
                    self.land()
                except TelloError as error:
                    logger.error("%s", error)
            elif now - self._last_sent_s > self.limits.keep_alive_s and math.isfinite(self._last_sent_s):
                self._keep_alive()

    def _why_land(self, now: float) -> str:
        state_s = self.latest.stamp_s if self.latest is not None else self._flight_begin_s
        if now - max(state_s, self._flight_begin_s) > self.limits.state_loss_s:
            return f"no state for {self.limits.state_loss_s:.0f} s"
        if self._video is not None:
            newest = self._video.newest
            picture_s = max(newest.stamp_s if newest is not None else 0.0, self._video_begin_s, self._flight_begin_s)
            if now - picture_s > self.limits.video_loss_s:
                return f"no video for {self.limits.video_loss_s:.0f} s"
        return self._unfit()

    def _keep_alive(self) -> None:
        if not self._sending.acquire(blocking=False):
            return  # another thread is talking to the drone anyway
        try:
            self.send("battery?", timeout_s=1.0, retries=0)
        except TelloError:
            logger.debug("keep-alive was not answered")
        finally:
            self._sending.release()
