"""``edgeslam record``: a flight or a camera into a folder that every other command reads."""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgeslam_torch.io.flight_writer import FlightWriter
    from edgeslam_torch.io.live import LiveSource
    from edgeslam_torch.io.tello import StateMessage, Tello

EXIT_INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("source", metavar="SOURCE", help="tello://HOST[:PORTS], webcam:N, rtsp://..., udp://...")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder (default: flights/DATE-TIME)")
    parser.add_argument("--camera", metavar="FILE|PRESET", help="calibration that is stored with the recording")
    parser.add_argument("--duration", type=float, metavar="S", help="stop after this time (default: until Ctrl-C)")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")
    parser.add_argument("--lossless", action="store_true", help="PNG instead of JPEG (quality 95)")
    parser.add_argument(
        "--fly",
        action="store_true",
        help="let the drone move: take off, climb and sink half a metre (for scale), turn, hover; it lands at the end",
    )


def main(args: argparse.Namespace) -> int:
    """Record until told to stop, and say what was recorded."""
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.io.flight_writer import FlightWriter
    from edgeslam_torch.io.live import open_live, open_tello
    from edgeslam_torch.io.tello import TelloError

    is_drone = args.source.startswith("tello://")
    if args.fly and not is_drone:
        raise ConfigError(f"{args.source}: --fly is for a drone (tello://HOST)")
    if (args.max_frames is not None and args.max_frames < 1) or (args.duration is not None and args.duration <= 0):
        raise ConfigError("--max-frames and --duration must be positive")
    folder = args.out or Path("flights") / time.strftime("%Y%m%d-%H%M%S")
    messages: list[StateMessage] = []
    tello: Tello | None = None
    if is_drone:
        source, tello, messages = open_tello(args.source, args.camera, args.max_frames, args.fly)
    else:
        source = open_live(args.source, args.camera, args.max_frames)
    for warning in source.warnings:
        print(f"warning: {warning}")
    interrupted, failure = False, None
    try:
        with FlightWriter(folder, source.camera, is_drone, args.lossless) as writer:
            print(f"recording to {folder}; Ctrl-C ends it", flush=True)
            try:
                _record(source, writer, messages, tello if args.fly else None, args.duration)
            except KeyboardInterrupt:
                interrupted = True
            except TelloError as error:  # said once the drone is down and what was recorded has been told
                failure = error
            finally:
                source.close()  # lands; its state messages are recorded as well
                _write_states(writer, messages)
            print(f"{writer.frames} frames, {writer.states} state messages in {folder}")
    finally:
        source.close()
    for problem in source.problems:
        print(f"note: {problem.file}: {problem.reason}")
    if tello is not None and tello.stop_reason:
        print(f"note: the flight was ended: {tello.stop_reason}")
    if failure is not None:
        raise failure
    return EXIT_INTERRUPTED if interrupted else 0


def _record(
    source: "LiveSource",
    writer: "FlightWriter",
    messages: "list[StateMessage]",
    tello: "Tello | None",
    duration_s: float | None,
) -> None:
    begin = time.monotonic()
    pilot = _start_pilot(tello) if tello is not None else None
    for frame in source.frames():
        writer.add_frame(frame)
        _write_states(writer, messages)
        if duration_s is not None and time.monotonic() - begin > duration_s:
            break
        if pilot is not None:
            pilot()


def _write_states(writer: "FlightWriter", messages: "list[StateMessage]") -> None:
    while writer.states < len(messages):
        writer.add_state(messages[writer.states])


def _start_pilot(tello: "Tello") -> Callable[[], None]:
    """A short flight in a thread of its own; the returned function raises what went wrong in it."""
    import logging
    import threading
    from functools import partial

    from edgeslam_torch.errors import EdgeSlamError
    from edgeslam_torch.io.tello import NoAnswer

    failures: list[EdgeSlamError] = []

    def fly() -> None:
        try:
            tello.take_off()
            steps = [partial(tello.move, 0.0, 0.0, 0.5), partial(tello.move, 0.0, 0.0, -0.5)]
            for step in [*steps, partial(tello.turn, 0.7), partial(tello.turn, -0.7)]:
                try:
                    step()
                except NoAnswer as error:  # a lost packet; the next step does not rest on this one
                    logging.getLogger(__name__).warning("%s; going on", error)
        except EdgeSlamError as error:
            failures.append(error)

    threading.Thread(target=fly, name="pilot", daemon=True).start()

    def check() -> None:
        if failures:
            raise failures[0]

    return check
