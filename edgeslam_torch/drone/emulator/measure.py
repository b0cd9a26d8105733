"""Frame rate and delay at our client while it flies an emulator in another process."""

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.drone.emulator.stopwatch import age_s, read_time
from edgeslam_torch.drone.tello import StateMessage, Tello, TelloAddress, TelloError
from edgeslam_torch.drone.udp import open_udp
from edgeslam_torch.drone.video_stream import Picture
from edgeslam_torch.errors import SourceError
from edgeslam_torch.types import FloatArray

_START_S = 120.0
"""Timeout for the start; building a room takes seconds."""
_STICKS_S = 0.2


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurement at the client."""

    duration_s: float
    pictures: int
    """Decoded."""
    fresh: int
    """Pictures with a new time; the rest are repeats."""
    delay_s: FloatArray
    """``(pictures,)`` from the moment that a picture shows to the arrival of its last packet."""
    states: int
    undecodable: int

    def lines(self, video_latency_ms: float) -> list[str]:
        """Lines for the terminal."""
        rate, fresh, states = (n / self.duration_s for n in (self.pictures, self.fresh, self.states))
        lines = [
            f"{rate:.1f} pictures/s decoded, {fresh:.1f} of them new, {self.undecodable} undecodable, "
            f"{states:.1f} state messages/s, over {self.duration_s:.1f} s"
        ]
        if len(self.delay_s):
            median, p95 = 1e3 * np.percentile(self.delay_s, [50, 95])
            lines.append(
                f"delay of the picture {median:.0f} ms median, {p95:.0f} ms at 95 %; of that the emulated link "
                f"{video_latency_ms:.0f} ms, so painting, encoding and receiving {median - video_latency_ms:.0f} ms"
            )
        return lines


def measure(seconds: float, options: Sequence[str] = ()) -> Measured:
    """Fly an emulator with our client and time its pictures.

    Args:
        seconds: Measured flight after take-off.
        options: Of ``edgeslam sim``.

    Raises:
        SourceError: If the emulator does not start.
        TelloError: If the flight fails.
    """
    state_port, video_port = _free_port(), _free_port()
    command = [sys.executable, "-m", "edgeslam_torch.cli", "sim", "--stopwatch", "--command-port=0"]
    command += [f"--state-port={state_port}", f"--video-port={video_port}", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            address = TelloAddress("127.0.0.1", _command_port(process), state_port, video_port)
            return _fly(address, seconds)
        finally:
            process.terminate()


def _free_port() -> int:
    with open_udp(("127.0.0.1", 0), "free") as udp:
        return int(udp.getsockname()[1])


def _command_port(process: "subprocess.Popen[str]") -> int:
    """From the first line that the emulator prints."""
    line = process.stdout.readline() if process.stdout is not None else ""
    words = line.split("commands on ", 1)
    if len(words) < 2:
        raise SourceError(f"edgeslam sim: did not start: {line.strip() or 'it printed nothing'}")
    return int(words[1].split(",")[0].rsplit(":", 1)[1])


def _fly(address: TelloAddress, seconds: float) -> Measured:
    shown: list[tuple[float, float]] = []  # (moment shown, delay)
    pictures: list[float] = []
    states: list[float] = []

    def on_picture(picture: Picture) -> None:
        arrived = picture.stamp_s - offset
        pictures.append(arrived)
        moment = read_time(picture.image)
        if moment is not None:
            shown.append((moment, age_s(moment, arrived)))

    def on_state(message: StateMessage) -> None:
        states.append(message.stamp_s - offset)

    with Tello(address, allow_motion=True, on_state=on_state, on_picture=on_picture) as tello:
        offset = tello.clock.now() - time.monotonic()
        tello.connect(_START_S)
        video = tello.start_video()
        if video.wait(0, _START_S) is None:
            raise TelloError(f"{address.host}: no picture in {_START_S:.0f} s")
        tello.take_off()
        before = (len(shown), len(pictures), len(states), video.undecodable)
        begin = time.monotonic()
        while (flown := time.monotonic() - begin) < seconds and not tello.stop_reason:
            tello.rc(0.1 * np.sin(flown), 0.2 * np.cos(0.7 * flown), 0.0, 0.3)
            video.wait(10**9, min(_STICKS_S, seconds - flown))
        used = slice(before[0], len(shown))
        counts = (len(pictures) - before[1], len(states) - before[2], video.undecodable - before[3])
    moments = [moment for moment, _ in shown[used]]
    fresh = len(dict.fromkeys(moments))
    return Measured(flown, counts[0], fresh, np.array([d for _, d in shown[used]]), counts[1], counts[2])
