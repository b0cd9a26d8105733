"""``edgeslam sim``: a simulated Tello on the loopback interface."""

import argparse
import math
import signal
import time

_POLL_S = 0.1
"""A signal delivered to another thread does not wake the main thread, which handles it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS", help="listen here (default: loopback only)")
    parser.add_argument("--command-port", type=int, default=8889, metavar="PORT", help="default: 8889")
    parser.add_argument("--state-port", type=int, default=8890, metavar="PORT", help="client's port, default: 8890")
    parser.add_argument("--video-port", type=int, default=11111, metavar="PORT", help="client's port, default: 11111")
    parser.add_argument(
        "--world",
        metavar="NAME|FILE",
        help="a world such as l_corridor, or a scene file *.toml (default: a furnished room)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the world (default: 0)")
    parser.add_argument("--wind", type=float, default=0.0, metavar="M_S", help="mean wind across, half of it as gusts")
    parser.add_argument("--battery", type=float, default=100.0, metavar="PERCENT", help="charge at the start")
    parser.add_argument("--drain", type=float, default=13.0, metavar="MINUTES", help="flight time of a full battery")
    parser.add_argument("--loss", type=float, default=0.0, metavar="PERCENT", help="packets lost, each way")
    parser.add_argument("--latency", type=float, default=3.0, metavar="MS", help="of commands and state")
    parser.add_argument(
        "--video-latency", type=float, default=300.0, metavar="MS", help="of the picture (default: 300)"
    )
    parser.add_argument("--tilt", type=float, default=12.0, metavar="DEGREES", help="of the camera, downwards")
    parser.add_argument(
        "--render-width", type=int, default=480, metavar="PX", help="pictures are painted this wide, sent 960 wide"
    )
    parser.add_argument("--sdk", choices=("1.3", "2.0"), default="2.0", help="form of the state lines")
    parser.add_argument("--duration", type=float, metavar="S", help="stop after this time (default: until Ctrl-C)")
    parser.add_argument("--stopwatch", action="store_true", help="show the time of each picture in its corner")
    parser.add_argument(
        "--measure",
        type=float,
        metavar="S",
        help="fly the emulator with our client for this time and print frame rate and delay",
    )


def main(args: argparse.Namespace) -> int:
    """Emulate until Ctrl-C."""
    from edgeslam_torch.drone.emulator.air import Air
    from edgeslam_torch.drone.emulator.link import LinkFaults
    from edgeslam_torch.drone.emulator.room import drone_at, furnished_drone
    from edgeslam_torch.drone.emulator.server import EmulatorConfig, TelloEmulator
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.synthetic.sites.build import named_site

    if args.measure is not None:
        return _measure(args)
    import numpy as np

    width = args.render_width
    if args.seed < 0:
        raise ConfigError(f"--seed must be at least 0, got {args.seed}")
    if not 64 <= width <= 960 or not 0 < args.battery <= 100 or args.drain <= 0:
        raise ConfigError("--render-width must be 64 to 960, --battery above 0 up to 100, --drain positive")
    try:
        faults = LinkFaults(args.loss / 100.0, args.latency / 1e3, args.video_latency / 1e3)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    ports = (args.command_port, args.state_port, args.video_port)
    if not all(0 <= port < 65536 for port in ports):
        raise ConfigError(f"ports must be 0 to 65535, got {ports}")
    config = EmulatorConfig(
        args.bind, *ports, link=faults, seed=args.seed, mission_pads=args.sdk == "2.0", stopwatch=args.stopwatch
    )
    size = (width, round(width * 0.75))
    if not 0 <= args.wind <= 2:
        raise ConfigError(f"--wind must be 0 to 2 m/s, got {args.wind:g}")
    tilt, charge = math.radians(args.tilt), args.battery / 100.0
    if args.world is None:
        drone, paint, _ = furnished_drone(args.seed, tilt, size, charge)
    else:
        drone, paint, _ = drone_at(named_site(args.world, args.seed), tilt, size, charge)
    drone.air = Air(np.array([0.0, args.wind, 0.0]), 0.5 * args.wind, np.random.default_rng(args.seed))
    drone.battery_per_s = 1.0 / (60.0 * args.drain)
    signals: list[int] = []
    previous = signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    try:
        with TelloEmulator(config, paint, drone) as emulator:
            host = args.bind if args.bind != "0.0.0.0" else "this machine's address"
            print(
                f"Tello emulator: commands on {host}:{emulator.command_port}, state to port {args.state_port}, ", end=""
            )
            print(f"video to port {args.video_port}; Ctrl-C stops it", flush=True)
            address = _address(args, emulator.command_port)
            print(
                f"it stands on the floor; try: edgeslam record {address} --fly --duration 30 --out flights/first, "
                "then: edgeslam run flights/first",
                flush=True,
            )
            end_s = math.inf if args.duration is None else time.monotonic() + args.duration
            while not signals and (left_s := end_s - time.monotonic()) > 0:
                time.sleep(min(left_s, _POLL_S))
    except KeyboardInterrupt:
        return 130
    finally:
        signal.signal(signal.SIGTERM, previous)
    return 0


def _address(args: argparse.Namespace, command_port: int) -> str:
    """Address for a client on this machine, with ports only if not the default ones."""
    host = "127.0.0.1" if args.bind == "0.0.0.0" else args.bind
    ports = (command_port, args.state_port, args.video_port)
    return f"tello://{host}" + ("" if ports == (8889, 8890, 11111) else ":{}:{}:{}".format(*ports))


def _measure(args: argparse.Namespace) -> int:
    from edgeslam_torch.drone.emulator.measure import measure
    from edgeslam_torch.errors import ConfigError

    if not args.measure > 0:
        raise ConfigError("--measure must be positive")
    options = {
        "seed": args.seed,
        "loss": args.loss,
        "latency": args.latency,
        "video-latency": args.video_latency,
        "render-width": args.render_width,
    }
    found = measure(args.measure, [f"--{name}={value}" for name, value in options.items()])
    for line in found.lines(args.video_latency):
        print(line)
    return 0
