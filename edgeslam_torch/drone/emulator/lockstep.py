"""The emulated Tello on a simulated clock: a flight depends on its seed and its commands, not on the machine's load."""

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Literal

import numpy as np

from edgeslam_torch.drone.emulator.commands import Answer, Interpreter
from edgeslam_torch.drone.emulator.drone import SILENCE_LAND_S, STEP_S, Contact, DroneModel, state_line
from edgeslam_torch.types import FloatArray

Channel = Literal["command", "state", "video"]


@dataclass(frozen=True, slots=True)
class Outage:
    """A time during which a channel carries nothing."""

    channel: Channel
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class Radio:
    """Delays and losses between the drone and its pilot's computer."""

    command_s: float = 0.08
    """From a command to its effect: the radio and the drone's own loop."""
    state_s: float = 0.05
    video_s: float = 0.35
    """From light to a decoded picture; 0.3 to 0.5 s on a Tello."""
    loss: float = 0.0
    """Share of commands, state lines and pictures that never arrive."""
    outages: tuple[Outage, ...] = ()
    video_hz: float = 15.0
    state_hz: float = 10.0

    def __post_init__(self) -> None:
        if min(self.command_s, self.state_s, self.video_s) < 0 or not 0 <= self.loss < 1:
            raise ValueError(f"delays are at least 0 and the loss in [0, 1): {self}")
        if not 0 < self.video_hz <= 60 or not 0 < self.state_hz <= 50:
            raise ValueError(f"pictures come at up to 60 Hz, state at up to 50 Hz: {self}")


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture that arrives."""

    arrived_s: float
    captured_s: float
    image: np.ndarray
    """``(H, W, 3)`` BGR."""
    T_w_b: FloatArray
    """``(4, 4)`` true pose of the body when it was taken: for judges."""


@dataclass(frozen=True, slots=True)
class State:
    """A line of state that arrives."""

    arrived_s: float
    text: str


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to a command that arrives."""

    arrived_s: float
    text: str


Event = Picture | State | Reply | Contact


@dataclass(slots=True)
class LockstepTello:
    """A Tello whose time passes only in `advance`."""

    drone: DroneModel
    paint: Callable[[FloatArray], np.ndarray]
    """Gives the picture for a body pose ``(4, 4)``."""
    link: Radio = field(default_factory=Radio)
    seed: int = 0
    """Of the losses."""
    clock_s: float = 0.0
    _steps: int = 0
    _queue: list[tuple[float, int, object]] = field(default_factory=list)
    """What is on its way, by its time of arrival: commands (str) and events."""
    _number: Iterator[int] = field(default_factory=count)
    _pending: list[str] = field(default_factory=list)
    """Answers that wait for the end of a movement."""
    _last_command_s: float = 0.0
    _next_picture_s: float = 0.0
    _next_state_s: float = 0.0
    _interpreter: Interpreter = field(init=False)
    _rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self._interpreter = Interpreter(self.drone)
        self._interpreter.run("command")
        self._rng = np.random.default_rng([self.seed, 0x7E110])

    def send(self, command: str) -> None:
        """Send a line of the SDK, such as ``takeoff`` or ``rc 0 30 0 0``; its effect comes after the link's delay."""
        if self._carries("command"):
            self._post(self.clock_s + self.link.command_s, command)

    def advance(self, seconds: float) -> list[Event]:
        """Let time pass; returns what arrives at the pilot's computer, in order, and contacts when they happen.

        Raises:
            ValueError: If ``seconds`` is not a positive number.
        """
        if not 0 < seconds < 3600:
            raise ValueError(f"a step must be longer than 0 s and shorter than an hour, got {seconds} s")
        until_s = self.clock_s + seconds
        arrived: list[Event] = []
        while (self._steps + 1) * STEP_S <= until_s + 1e-9:
            self._steps += 1
            self.clock_s = self._steps * STEP_S
            arrived += self._step()
        self.clock_s = until_s
        return arrived

    def _step(self) -> list[Event]:
        out: list[Event] = []
        while self._queue and self._queue[0][0] <= self.clock_s:
            item = heapq.heappop(self._queue)[2]
            if isinstance(item, str):
                self._obey(item)
            else:
                out.append(item)  # type: ignore[arg-type]
        touched = len(self.drone.contacts)
        self.drone.step(STEP_S)
        out += self.drone.contacts[touched:]
        if self.drone.flying and self.clock_s - self._last_command_s > SILENCE_LAND_S:
            self.drone.land()
        if self._pending and not self.drone.busy:
            for text in self._pending:
                self._reply(text)
            self._pending = []
        self._report()
        return out

    def _obey(self, command: str) -> None:
        self._last_command_s = self.clock_s
        reply = self._interpreter.run(command)
        if reply.when is Answer.NOW:
            self._reply(reply.text)
        elif reply.when is Answer.WHEN_DONE:
            self._pending.append(reply.text)

    def _reply(self, text: str) -> None:
        if self._carries("state"):
            at_s = self.clock_s + self.link.state_s
            self._post(at_s, Reply(at_s, text))

    def _report(self) -> None:
        """Send a picture and a line of state when they are due."""
        if self.clock_s >= self._next_picture_s:
            self._next_picture_s += 1.0 / self.link.video_hz
            if self._carries("video"):
                T_w_b, at_s = self.drone.T_w_b(), self.clock_s + self.link.video_s
                self._post(at_s, Picture(at_s, self.clock_s, self.paint(T_w_b), T_w_b))
        if self.clock_s >= self._next_state_s:
            self._next_state_s += 1.0 / self.link.state_hz
            if self._carries("state"):
                at_s = self.clock_s + self.link.state_s
                self._post(at_s, State(at_s, state_line(self.drone)))

    def _carries(self, channel: Channel) -> bool:
        lost = self._rng.random() < self.link.loss
        cut = any(o.channel == channel and o.from_s <= self.clock_s < o.to_s for o in self.link.outages)
        return not lost and not cut

    def _post(self, at_s: float, item: object) -> None:
        heapq.heappush(self._queue, (at_s, next(self._number), item))
