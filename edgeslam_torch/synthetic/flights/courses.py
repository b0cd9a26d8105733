"""Named kinds of simulated flights: where, how and with which camera a drone flies."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.imu import ImuModel
from edgeslam_torch.synthetic.flights.degrade import CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight, FlightPlan, climb, fly, fly_after_hover, fly_around, turn
from edgeslam_torch.synthetic.flights.imu import mounted, simulate_imu
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate
from edgeslam_torch.synthetic.flights.writer import write_flight
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.build import place

Rng = np.random.Generator
SECONDS, RATE_HZ = 16.0, 20.0
"""Length and frame rate of most courses, and of the demo."""


class Pilot(Protocol):
    """Flies through a world, as `fly` does."""

    def __call__(
        self, rng: Rng, world: World, frames: int, *, rate_hz: float, plan: FlightPlan | None = None
    ) -> Flight:
        """A flight of ``frames`` frames."""


@dataclass(frozen=True, slots=True)
class Course:
    """One kind of flight; the seed decides place, furniture, path and noise."""

    scene: str = "furnished_room"
    """A name in `synthetic/scenes`."""
    pilot: Pilot = fly
    faults: CameraFaults = field(default_factory=CameraFaults)
    telemetry: TelemetryFaults | None = field(default_factory=TelemetryFaults)
    """None flies without telemetry."""
    seconds: float = SECONDS
    rate_hz: float = RATE_HZ

    def world(self, rng: Rng) -> World:
        """Its place."""
        return place(self.scene, rng)


BLOCK_M, BUILDING_M = (11.0, 9.0), (16.0, 4.0)
"""Sides of the line through the scenes ``block`` and ``building``: once around is 40 m."""
AROUND_BLOCK = partial(fly_around, sides_m=BLOCK_M, plan=FlightPlan(speed_m_s=0.8))
AROUND_BUILDING = partial(fly_around, sides_m=BUILDING_M, plan=FlightPlan(speed_m_s=0.8))
WIND = FlightPlan(wind_m_s2=0.5, gust_m_s2=0.3)
"""As under an open window: three degrees of lean, and gusts that move the drone by 8 cm to each side."""
LOW_LIGHT = CameraFaults(gain=0.2, read_noise=2.5, shot_noise=0.35, vignetting=0.3, shutter_s=0.02)
"""A fifth of the light at a slow shutter: walls at about 40 grey levels, noise of 3, blur of some pixels in a turn."""

COURSES = {
    "room": Course(),
    "room_no_telemetry": Course(telemetry=None),
    "corridor": Course("long_corridor"),
    "corridor_no_telemetry": Course("long_corridor", telemetry=None),
    "blank_corridor": Course("long_blank_corridor"),
    "block": Course("block", AROUND_BLOCK, seconds=64.0, rate_hz=15.0),
    "block_no_telemetry": Course("block", AROUND_BLOCK, telemetry=None, seconds=64.0, rate_hz=15.0),
    "building": Course("building", AROUND_BUILDING, seconds=64.0, rate_hz=15.0),
    "climb": Course(pilot=climb),
    "yaw": Course(pilot=turn),
    "windy_room": Course(pilot=partial(fly, plan=WIND)),
    "windy_corridor": Course("long_corridor", partial(fly, plan=WIND)),
    "windy_blank_corridor": Course("long_blank_corridor", partial(fly, plan=WIND)),
    "windy_climb": Course(pilot=partial(climb, plan=WIND)),
    "windy_hover_first": Course(pilot=partial(fly_after_hover, plan=WIND)),
    "low_light": Course(faults=LOW_LIGHT),
    "turn_first": Course(pilot=partial(fly_after_hover, turning=True)),
    "hover_first": Course(pilot=fly_after_hover),
}
"""By name. ``block`` and ``building`` go once around, 40 m, and 5 m on along the path flown before."""

DEPTH_EVERY = 10
"""Frames from one exact depth map to the next."""


def simulated_camera(width: int = 640, height: int = 480) -> Camera:
    """A Tello's camera, without distortion, at another size."""
    return replace(PRESETS["tello"].scaled(width, height), source="simulated Tello")


def flown(course: Course, seed: int, seconds: float | None = None) -> tuple[World, Flight, Rng]:
    """World and flight of a course, and the generator that goes on with its telemetry.

    Raises:
        ValueError: If the world has no free place to fly in.
    """
    rng = np.random.default_rng(seed)
    world = course.world(rng)
    frames = round((course.seconds if seconds is None else seconds) * course.rate_hz)
    return world, course.pilot(rng, world, frames, rate_hz=course.rate_hz), rng


def record_course(folder: Path, course: Course, seed: int, seconds: float | None = None, threads: int = 1) -> None:
    """Fly a course and leave its recording in ``folder``.

    Raises:
        OutputError: If the folder cannot be written to.
    """
    world, flight, rng = flown(course, seed, seconds)
    record_flight(
        folder, world, flight, rng, simulated_camera(), course.telemetry, course.faults, seed=seed, threads=threads
    )


def record_flight(
    folder: Path,
    world: World,
    flight: Flight,
    rng: Rng,
    camera: Camera,
    telemetry: TelemetryFaults | None,
    faults: CameraFaults,
    *,
    seed: int,
    imu: ImuModel | None = None,
    threads: int = 1,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write a flight's images, truth, exact depth, telemetry and IMU readings into ``folder``.

    Args:
        folder: Made when missing.
        world: What is seen.
        flight: Where from.
        rng: Of the telemetry's noise.
        camera: Intrinsics.
        telemetry: How bad the telemetry is; None for none.
        faults: What the camera does to the images.
        seed: Of the image and IMU noise.
        imu: Grade of an IMU in the axes of the drone's body; None for none.
        threads: Frames drawn at a time.
        on_frame: Called with the number of frames done.

    Raises:
        OutputError: If something cannot be written.
    """
    log = None
    if telemetry is not None:
        floor = world.floor_below(flight.T_w_b[:, :3, 3])
        log = simulate(rng, flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=telemetry, floor_m=floor)
    measured = None
    if imu is not None:
        model = mounted(imu, flight.T_b_c)
        measured = simulate_imu(np.random.default_rng([seed, 59]), flight.stamps_s, flight.T_w_c, model), model
    write_flight(
        folder,
        world,
        flight,
        camera,
        telemetry=log,
        imu=measured,
        faults=faults,
        seed=seed,
        depth_every=DEPTH_EVERY,
        threads=threads,
        on_frame=on_frame,
    )
