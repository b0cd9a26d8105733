"""Flights to a goal over the real UDP path, in real time, against an emulator in a process of its own.

``python -m edgeslam_torch.eval.judge.navigation.over_udp --world cluttered_room --flights 10``
"""

import argparse
import math
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.drone.emulator.server import EmulatorConfig, TelloEmulator
from edgeslam_torch.drone.udp import open_udp
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.judge.navigation.behaviours import REACHED_M
from edgeslam_torch.eval.judge.navigation.flight import contact_events
from edgeslam_torch.flying.navigator import Navigator
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.synthetic.sites.build import SITES, named_site

_SIZE = (480, 360)
_RATE_HZ = 15
"""Frame rate: half of a Tello's, since the same machine renders the frames; 15 Hz are processed in flight."""


@dataclass(frozen=True, slots=True)
class Landed:
    """True state at the end of a flight."""

    distance_m: float
    """Horizontal distance to the goal."""
    contacts: int
    """Contact events, including the landing."""
    clearance_m: float
    """Minimum distance of the hull from obstacles in flight; infinite if it never flew."""
    on_floor: bool
    """Whether it stands on the floor, not on furniture, with motors off."""


def emulate(world: str, seed: int, ports: tuple[int, int], pipe: Connection) -> None:
    """Process of the emulator: sends its command port, waits for a message, sends `Landed`."""
    site = named_site(world, seed)
    drone, paint, _ = drone_at(site, TELLO_TILT_RAD, _SIZE)
    true_m, nearest = drone.clearance, [math.inf]

    def noted(p_w: np.ndarray) -> float:
        away = true_m(p_w)
        if drone.flying:
            nearest[0] = min(nearest[0], away)
        return away

    drone.clearance = noted
    with TelloEmulator(EmulatorConfig("127.0.0.1", 0, *ports, rate_hz=_RATE_HZ, seed=seed), paint, drone) as emulator:
        pipe.send(emulator.command_port)
        pipe.recv()
        away = float(np.linalg.norm(drone.p_w[:2] - site.goal_w[:2]))
        contacts = contact_events([contact.clock_s for contact in drone.contacts])
        pipe.send(Landed(away, contacts, nearest[0] - 0.1, not drone.flying and drone.p_w[2] < 0.15))


def fly_one(world: str, seed: int, record: Path | None = None) -> str:
    """One flight to the site's goal, as a line of a table."""
    with open_udp(("127.0.0.1", 0), "free") as a, open_udp(("127.0.0.1", 0), "free") as b:
        ports = (int(a.getsockname()[1]), int(b.getsockname()[1]))
    here, there = get_context("spawn").Pipe()
    process = get_context("spawn").Process(target=emulate, args=(world, seed, ports, there))
    process.start()
    try:
        goal = named_site(world, seed).goal_w
        address = f"tello://127.0.0.1:{here.recv()}:{ports[0]}:{ports[1]}"
        said, reason = _fly(address, goal, record)
        here.send("landed")
        found: Landed = here.recv()
    finally:
        process.terminate()
        process.join()
    reached = said and found.distance_m < REACHED_M and not found.contacts
    return (
        f"| {world} {seed} | {'yes' if reached else 'no'} | {reason} | {found.distance_m:.2f} | {found.contacts} | "
        f"{found.clearance_m:.2f} | {'yes' if found.on_floor else 'no'} |"
    )


def _fly(address: str, goal_w: np.ndarray, record: Path | None) -> tuple[bool, str]:
    """Whether the flight reports success, and its reason."""
    try:
        with Navigator.open(address, allow_motion=True, camera="tello", record=record) as nav:
            outcome = nav.take_off()
            if outcome.reached:
                outcome = nav.go_to((*goal_w[:2], nav.limits.height_m))
            if nav.vehicle.flying:
                nav.land()
    except EdgeSlamError as error:
        return False, str(error)
    return outcome.reached, outcome.reason


def main() -> None:
    """Fly and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--world", action="append", metavar="NAME", choices=sorted(SITES), help="default: cluttered_room"
    )
    parser.add_argument("--flights", type=int, default=10, help="for each world (default: 10)")
    parser.add_argument("--first-seed", type=int, default=200, help="default: 200")
    parser.add_argument("--record", type=Path, metavar="DIR", help="record the flights into folders in it")
    args = parser.parse_args()
    if args.flights < 1 or args.first_seed < 0:
        parser.error("--flights must be at least 1, --first-seed at least 0")
    print("| world, seed | reached | ended | from the goal [m] | contacts | clearance min [m] | on the floor |")
    print("|---|---|---|---|---|---|---|")
    for world in args.world or ["cluttered_room"]:
        for seed in range(args.first_seed, args.first_seed + args.flights):
            record = None if args.record is None else args.record / f"{world}_{seed}"
            print(fly_one(world, seed, record), flush=True)


if __name__ == "__main__":
    main()
