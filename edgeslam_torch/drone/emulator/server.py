"""The emulated Tello on its sockets: listens for commands, sends state and video."""

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from edgeslam_torch.drone.emulator.commands import Answer, Interpreter
from edgeslam_torch.drone.emulator.drone import SILENCE_LAND_S, STEP_S, DroneModel, state_line
from edgeslam_torch.drone.emulator.encoder import Encoder
from edgeslam_torch.drone.emulator.link import Link, LinkFaults
from edgeslam_torch.drone.emulator.stopwatch import draw_time
from edgeslam_torch.drone.udp import open_udp
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

Render = Callable[[FloatArray], np.ndarray]
"""Picture (H, W, 3) BGR that the drone's camera sees with its body at ``T_w_b`` (4, 4)."""

_STATE_S = 0.1


@dataclass(frozen=True, slots=True)
class EmulatorConfig:
    """Ports and behaviour."""

    bind: str = "127.0.0.1"
    command_port: int = 8889
    state_port: int = 8890
    video_port: int = 11111
    width: int = 960
    height: int = 720
    rate_hz: int = 30
    mission_pads: bool = True
    """State in the SDK 2.0 form; false gives the form of 1.3."""
    link: LinkFaults = field(default_factory=LinkFaults)
    seed: int = 0
    stopwatch: bool = False
    """Draw the time (`time.monotonic`) of the rendered pose into each picture."""


class TelloEmulator:
    """Threads for commands, body and state, pictures, and video; use it as a context manager.

    Args:
        config: Ports and faults.
        render: Gives the picture for a body pose; a grey test card without it.
        drone: The body; a fresh one without it.
    """

    def __init__(self, config: EmulatorConfig, render: Render | None = None, drone: DroneModel | None = None) -> None:
        self.config = config
        self.drone = drone or DroneModel()
        self.interpreter = Interpreter(self.drone)
        self.frozen = False
        """Stops answering and sending, like crashed firmware; the drone lands without commands."""
        self._render = render or _test_card(config.width, config.height)
        self._socket = open_udp((config.bind, config.command_port), "command")
        self._socket.settimeout(0.1)
        self.command_port = int(self._socket.getsockname()[1])
        self.link = Link(config.link, config.seed)
        self._lock = threading.Lock()
        self._client: tuple[str, int] | None = None
        self._last_command_s = time.monotonic()
        self._pending: list[tuple[tuple[str, int], str]] = []
        self._stopping = threading.Event()
        self._picture: np.ndarray | None = None
        self._painted = threading.Event()
        """A picture that was not sent yet."""
        self._threads = [
            threading.Thread(target=work, name=f"emulator-{name}", daemon=True)
            for name, work in (
                ("commands", self._listen),
                ("body", self._fly),
                ("pictures", self._paint),
                ("video", self._stream),
            )
        ]

    def start(self) -> "TelloEmulator":
        """Start listening."""
        for thread in self._threads:
            thread.start()
        return self

    def stop(self) -> None:
        """Stop and close the sockets."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self.link.stop()
        self._socket.close()

    def __enter__(self) -> "TelloEmulator":
        return self.start()

    def __exit__(self, *unused: object) -> None:
        self.stop()

    def _listen(self) -> None:
        while not self._stopping.is_set():
            try:
                packet, sender = self._socket.recvfrom(2048)
            except (TimeoutError, ConnectionError):
                continue
            except OSError:
                return
            if self.frozen or not self.link.passes():
                continue
            text = packet.decode("ascii", errors="replace").strip("\x00 \r\n")
            with self._lock:
                self._client = sender
                self._last_command_s = time.monotonic()
                reply = self.interpreter.run(text)
                logger.debug("%s -> %s (%s)", text, reply.text.strip(), reply.when)
                if reply.when is Answer.WHEN_DONE:
                    self._pending.append((sender, reply.text))
            if reply.when is Answer.NOW:
                self._answer(sender, reply.text)

    def _answer(self, to: tuple[str, int], text: str) -> None:
        self.link.send(self._socket, text.encode("ascii", errors="replace"), to, self.config.link.latency_s)

    def _fly(self) -> None:
        """Body at 100 Hz, state at 10 Hz, and the landing after 15 s of silence."""
        begin, steps = time.monotonic(), 0
        next_state = begin
        while not self._stopping.is_set():
            now = time.monotonic()
            with self._lock:
                while begin + steps * STEP_S < now:
                    self.drone.step(STEP_S)
                    steps += 1
                if self.drone.flying and now - self._last_command_s > SILENCE_LAND_S:
                    self.drone.land()
                done = [] if self.drone.busy else self._pending
                self._pending = self._pending[len(done) :]
                client, ready = self._client, self.interpreter.sdk_mode
                line = state_line(self.drone, mission_pads=self.config.mission_pads)
            if not self.frozen:
                for to, text in done:
                    self._answer(to, text)
                if client is not None and ready and now >= next_state:
                    to = (client[0], self.config.state_port)
                    self.link.send(self._socket, line.encode("ascii"), to, self.config.link.latency_s)
            if now >= next_state:
                next_state += _STATE_S * max(1, math.ceil((now - next_state) / _STATE_S))
            self._stopping.wait(STEP_S)

    def _paint(self) -> None:
        """Render at each tick, or as fast as possible; `_stream` encodes concurrently."""
        next_s = time.monotonic()
        while not self._stopping.is_set():
            if not self.interpreter.stream:
                self._stopping.wait(0.02)
                continue
            self._stopping.wait(max(0.0, next_s - time.monotonic()))
            next_s = max(next_s + 1.0 / self.config.rate_hz, time.monotonic())
            with self._lock:
                T_w_b, moment_s = self.drone.T_w_b(), time.monotonic()
            image = self._render(T_w_b)
            size = (self.config.width, self.config.height)
            if (image.shape[1], image.shape[0]) != size:
                image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))
            if self.config.stopwatch:
                draw_time(image, moment_s)
            self._picture = image
            self._painted.set()

    def _stream(self) -> None:
        """Send each new picture; repeat the last one if the next is late, keeping the rate."""
        encoder: Encoder | None = None
        tick_s = 1.0 / self.config.rate_hz
        next_s = time.monotonic()
        while not self._stopping.is_set():
            self._painted.wait(max(0.0, next_s + 0.5 * tick_s - time.monotonic()))
            self._stopping.wait(max(0.0, next_s - 0.4 * tick_s - time.monotonic()))
            self._painted.clear()
            next_s = max(next_s, time.monotonic() - tick_s) + tick_s
            client, picture = self._client, self._picture
            if not self.interpreter.stream or client is None or picture is None:
                encoder = None
                continue
            if encoder is None:
                encoder = Encoder(self.config.width, self.config.height, self.config.rate_hz)
            packets = encoder.encode(picture)
            if self.frozen:
                continue
            for packet in packets:
                to = (client[0], self.config.video_port)
                self.link.send(self._socket, packet, to, self.config.link.video_latency_s)


def _test_card(width: int, height: int) -> Render:
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    card = np.where((x // 40 + y // 40) % 2 == 0, 200, 60).astype(np.uint8)

    def render(T_w_b: FloatArray) -> np.ndarray:
        shift = int(round(200 * (T_w_b[0, 3] + T_w_b[1, 3])))
        return np.repeat(np.roll(card, shift, axis=1)[:, :, None], 3, axis=2)

    return render
