"""A flight to a goal over the real UDP path, in real time, against an emulator in a process of its own."""

import math
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np

from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.drone.emulator.server import EmulatorConfig, TelloEmulator
from edgeslam_torch.drone.udp import open_udp
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.navigation.behaviours import REACHED_M
from edgeslam_torch.eval.judge.navigation.flight import contact_events
from edgeslam_torch.eval.judge.navigation.flown import Case, Flown
from edgeslam_torch.eval.judge.navigation.perception import IMAGE_SIZE
from edgeslam_torch.flying.navigator import Navigator
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.synthetic.sites.build import named_site

_RATE_HZ = 15
"""Frame rate: half of a Tello's, since the same machine renders the frames; 15 Hz are processed in flight."""


def emulate(world: str, seed: int, ports: tuple[int, int], pipe: Connection) -> None:
    """Process of the emulator: sends its command port, waits for a message, sends the true state at the end: distance
    to the goal and to the take-off [m], contact events, least clearance beyond the hull [m], whether it is down."""
    site = named_site(world, seed)
    drone, paint, _ = drone_at(site, TELLO_TILT_RAD, IMAGE_SIZE)
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
        away = [float(np.linalg.norm(drone.p_w[:2] - place)) for place in (site.goal_w[:2], np.zeros(2))]
        contacts = contact_events([contact.clock_s for contact in drone.contacts])
        down = not drone.flying and bool(drone.p_w[2] < 0.15)  # on the floor, not on furniture
        pipe.send((*away, contacts, nearest[0] - NavLimits().radius_m, down))


def fly_over_udp(case: Case) -> Flown:
    """One flight to the site's goal; with the figures that the emulator provides.

    Raises:
        EvaluationError: If the case is another task than that, or has a fault.
    """
    if (case.fault, case.behaviour) != ("none", "goto"):
        raise EvaluationError(f"{case.behaviour} with fault {case.fault}: over UDP only goto without a fault is flown")
    with open_udp(("127.0.0.1", 0), "free") as a, open_udp(("127.0.0.1", 0), "free") as b:
        ports = (int(a.getsockname()[1]), int(b.getsockname()[1]))
    here, there = get_context("spawn").Pipe()
    process = get_context("spawn").Process(target=emulate, args=(case.world, case.seed, ports, there), daemon=True)
    process.start()
    found = Flown(case)
    try:
        goal = named_site(case.world, case.seed).goal_w
        said, found.ended = _fly(f"tello://127.0.0.1:{here.recv()}:{ports[0]}:{ports[1]}", goal)
        here.send("landed")
        found.distance_m, found.home_m, found.contacts, found.clearance_min_m, found.landed = here.recv()
    finally:
        process.terminate()
        process.join()
    found.clearance_p5_m = found.clearance_min_m
    found.reached = said and found.distance_m < REACHED_M and not found.contacts
    return found


def _fly(address: str, goal_w: np.ndarray) -> tuple[bool, str]:
    """Whether the flight reports success, and its reason."""
    try:
        with Navigator.open(address, allow_motion=True, camera="tello") as nav:
            outcome = nav.take_off()
            if outcome.reached:
                outcome = nav.go_to((*goal_w[:2], nav.limits.height_m))
            if nav.vehicle.flying:
                nav.land()
    except EdgeSlamError as error:
        return False, str(error)
    return outcome.reached, outcome.reason
