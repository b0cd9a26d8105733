"""``edgeslam record``: record a flight or a camera into a folder that all other commands read."""

import argparse
import math
import threading
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.commands.flying._signals import Signals, say
from edgeslam_torch.help.options import positive_amount, positive_number

if TYPE_CHECKING:
    from edgeslam_torch.drone.tello import Tello
    from edgeslam_torch.readers.live import LiveSource
    from edgeslam_torch.terminal.progress import Progress
    from edgeslam_torch.writers.flight_writer import FlightWriter


_SWEEP_M = (
    (0.0, 0.0, 0.5), (0.0, 0.0, -0.5), (0.0, 0.5, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 0.5), (0.0, 1.0, 0.0),
    (0.0, -0.5, -0.5),
)  # fmt: skip
"""Moves of ``--fly`` forward, left, up, which come back to where they began."""
_TURNS_RAD = (0.5, -1.0, 0.5)
_GAP_S = 0.5
"""Longest time that one state message's velocity stands for; they come ten times a second."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "source", metavar="SOURCE", help="tello://HOST[:PORTS], webcam:N, rtsp://..., http://..., gst:PIPELINE"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder (default: flights/DATE-TIME)")
    parser.add_argument("--camera", metavar="FILE|PRESET", help="calibration that is stored with the recording")
    parser.add_argument("--duration", type=positive_amount, metavar="S", help="stop then (default: at Ctrl-C)")
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop after N frames")
    parser.add_argument("--lossless", action="store_true", help="PNG instead of JPEG (quality 95)")
    parser.add_argument(
        "--fly",
        action="store_true",
        help="fly: take off, sweep up, down and to both sides by half a metre and turn, repeatedly, then land; needs a "
        "metre of free space around",
    )


def main(args: argparse.Namespace) -> int:
    """Record until stopped, and print a summary."""
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.readers.live import open_live, open_tello
    from edgeslam_torch.terminal.progress import Progress

    is_drone = args.source.startswith("tello://")
    if args.fly and not is_drone:
        raise ConfigError(f"{args.source}: --fly is for a drone (tello://HOST)")
    with Progress("waits for the drone" if is_drone else "waits for the camera") as progress, Signals() as signals:
        try:
            if is_drone:
                source, tello = open_tello(args.source, args.camera, args.max_frames, args.fly)
            else:
                source, tello = open_live(args.source, args.camera, args.max_frames), None
        except KeyboardInterrupt:
            say("interrupted; nothing was recorded")
            return signals.exit_code
        try:
            _record(args, source, tello if args.fly else None, signals, progress)
        finally:
            source.close()
    return signals.exit_code


def _record(
    args: argparse.Namespace,
    source: "LiveSource",
    tello: "Tello | None",
    signals: Signals,
    progress: "Progress",
) -> None:
    """One recording, with a summary after landing."""
    from edgeslam_torch.errors import EdgeSlamError
    from edgeslam_torch.writers.flight_writer import FlightWriter

    folder = args.out or Path("flights") / time.strftime("%Y%m%d-%H%M%S")
    printed = len(source.warnings)
    for warning in source.warnings:
        say(f"warning: {warning}")
    failure: EdgeSlamError | None = None
    with FlightWriter(folder, source.camera, args.source.startswith("tello://"), args.lossless) as writer:
        say(f"recording to {folder}; Ctrl-C ends it")
        # From here on no signal interrupts a flight or its landing; without a flight, a second signal does.
        signals.tell(source.end, patient=tello is not None)
        status = _Status(source)
        progress.phase("recording", args.max_frames, "picture")
        progress.words = status.text
        try:
            _write_frames(source, writer, tello, args.duration, progress, status)
        except EdgeSlamError as error:
            failure = error
        finally:
            status.ends = True
            if tello is not None and tello.airborne:  # in a thread: a stopped terminal must not delay the landing
                threading.Thread(target=say, args=("landing",), daemon=True).start()
            source.close()  # lands; its state messages are recorded too
        try:
            _write_states(writer, source)
        except EdgeSlamError as error:
            failure = failure or error
        say(f"{writer.frames} frames, {writer.states} state messages in {folder}")
    for warning in source.warnings[printed:]:
        say(f"warning: {warning}")
    for problem in source.problems:
        say(f"note: {problem.file}: {problem.reason}")
    if failure is not None:
        raise failure


def _write_frames(
    source: "LiveSource",
    writer: "FlightWriter",
    tello: "Tello | None",
    duration_s: float | None,
    progress: "Progress",
    status: "_Status",
) -> None:
    """Raises `TelloError` when the flight did not go as it should."""
    begin = time.monotonic()
    check = _start_pilot(tello, status) if tello is not None else lambda: None
    for frame in source.frames():
        writer.add_frame(frame)
        progress.advance()
        _write_states(writer, source)
        if duration_s is not None and time.monotonic() - begin > duration_s:
            break
        check()


class _Status:
    """The pilot's action, the drone's own state, and the time without a picture."""

    def __init__(self, source: "LiveSource") -> None:
        self._source = source
        self._read, self._flown_m, self._at_s = 0, 0.0, math.nan
        self.doing = ""
        """What the pilot does."""
        self.ends = False

    def text(self) -> str:
        """Battery, height and way of the newest state; the way by its velocities, the only ones there are."""
        from edgeslam_torch.terminal.run_progress import height_text

        parts = [("landing" if self.doing else "ending") if self.ends else self.doing]
        if not self.ends and self._source.silent_s >= 1.0:
            parts.append(f"no picture for {self._source.silent_s:.0f} s")
        sample = None
        for message in self._source.messages[self._read :]:
            sample = message.sample()
            step_m = float(np.linalg.norm(sample.velocity_m_s)) * min(sample.stamp_s - self._at_s, _GAP_S)
            self._flown_m += step_m if math.isfinite(step_m) else 0.0
            self._at_s = sample.stamp_s
            self._read += 1
        if self._source.messages:
            sample = sample or self._source.messages[-1].sample()
            parts += [f"battery {100 * sample.battery:.0f} %", height_text(sample), f"{self._flown_m:.1f} m flown"]
        return ", ".join(part for part in parts if part)


def _write_states(writer: "FlightWriter", source: "LiveSource") -> None:
    while writer.states < len(source.messages):
        writer.add_state(source.messages[writer.states])


def _start_pilot(tello: "Tello", status: "_Status") -> Callable[[], None]:
    """Sweep in a thread of its own until the flight ends; the returned function raises its error, if any.

    Sideways and up and down is what shows depth and scale; a hover shows neither.
    """
    import logging
    from functools import partial

    from edgeslam_torch.drone.tello import NoAnswer
    from edgeslam_torch.errors import EdgeSlamError

    failures: list[EdgeSlamError] = []

    def fly() -> None:
        try:
            status.doing = "taking off, waits for the drone to hover"
            tello.take_off()
            moves = [
                (partial(tello.move, *by), "moving {:g} m forward, {:g} left, {:g} up".format(*by)) for by in _SWEEP_M
            ]
            turns = [
                (partial(tello.turn, by), f"turning {math.degrees(by):.0f} degrees to the left") for by in _TURNS_RAD
            ]
            for step, words in cycle([*moves, *turns]):
                status.doing = f"{words}, waits for its answer"
                try:
                    step()
                except NoAnswer as error:  # a lost packet; the next step does not depend on it
                    logging.getLogger(__name__).warning("%s; going on", error)
        except EdgeSlamError as error:
            failures.append(error)

    threading.Thread(target=fly, name="pilot", daemon=True).start()

    def check() -> None:
        if failures and not tello.stop_reason:  # an aborted flight has its own reason
            raise failures[0]

    return check
