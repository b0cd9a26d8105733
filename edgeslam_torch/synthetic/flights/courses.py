"""Named kinds of simulated flights: where, how and with which camera a drone flies."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path as FilePath

import numpy as np

from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.synthetic.flights.degrade import CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight, FlightPlan, Path, fly
from edgeslam_torch.synthetic.flights.paths import HOVERED_S, around, climb, hover_first, inspect, turn
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults
from edgeslam_torch.synthetic.flights.writer import record_flight
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.build import place

Rng = np.random.Generator
SECONDS, RATE_HZ = 16.0, 20.0
"""Length and frame rate of most courses, and of the demo."""


@dataclass(frozen=True, slots=True)
class Course:
    """One kind of flight; the seed decides place, furniture, path and noise."""

    scene: str = "furnished_room"
    """A name in `synthetic/scenes`."""
    path: Path = inspect
    plan: FlightPlan = field(default_factory=FlightPlan)
    begin_s: float = 0.0
    """When its recording begins, after the path."""
    faults: CameraFaults = field(default_factory=CameraFaults)
    telemetry: TelemetryFaults | None = field(default_factory=TelemetryFaults)
    """None flies without telemetry."""
    seconds: float = SECONDS
    rate_hz: float = RATE_HZ

    def world(self, rng: Rng) -> World:
        """Its place."""
        return place(self.scene, rng)

    def fly(self, rng: Rng, world: World, frames: int, rate_hz: float | None = None) -> Flight:
        """A flight of ``frames`` frames, at the course's rate or another.

        Raises:
            ValueError: If the world has no free place to fly in.
        """
        rate_hz = rate_hz or self.rate_hz
        return fly(rng, world, frames, self.path, rate_hz=rate_hz, plan=self.plan, begin_s=self.begin_s)


BLOCK_M, BUILDING_M = (11.0, 9.0), (16.0, 4.0)
"""Sides of the line through the scenes ``block`` and ``building``: once around is 40 m."""
BRISK = FlightPlan(speed_m_s=0.8)
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
    "block": Course("block", around(BLOCK_M), BRISK, seconds=64.0, rate_hz=15.0),
    "block_no_telemetry": Course("block", around(BLOCK_M), BRISK, telemetry=None, seconds=64.0, rate_hz=15.0),
    "building": Course("building", around(BUILDING_M), BRISK, seconds=64.0, rate_hz=15.0),
    "climb": Course(path=climb),
    "yaw": Course(path=turn),
    "windy_room": Course(plan=WIND),
    "windy_corridor": Course("long_corridor", plan=WIND),
    "windy_blank_corridor": Course("long_blank_corridor", plan=WIND),
    "windy_climb": Course(path=climb, plan=WIND),
    "windy_hover_first": Course(path=hover_first, plan=WIND, begin_s=HOVERED_S),
    "low_light": Course(faults=LOW_LIGHT),
    "turn_first": Course(path=partial(hover_first, turning=True), begin_s=HOVERED_S),
    "hover_first": Course(path=hover_first, begin_s=HOVERED_S),
}
"""By name. ``block`` and ``building`` go once around, 40 m, and 5 m on along the path flown before."""


def simulated_camera(width: int = 640, height: int = 480) -> Camera:
    """A Tello's camera, without distortion, at another size."""
    return replace(PRESETS["tello"].scaled(width, height), source="simulated Tello")


def flown(course: Course, seed: int, seconds: float | None = None, flight: int = 0) -> tuple[World, Flight, Rng]:
    """World and flight of a course, and the generator for its telemetry.

    ``seed`` is of the world and its first flight; ``flight`` counts further ones in the same world, on other paths.

    Raises:
        ValueError: If the world has no free place to fly in.
    """
    rng = np.random.default_rng(seed)
    world = course.world(rng)
    if flight:
        rng = np.random.default_rng([seed, flight])
    frames = round((course.seconds if seconds is None else seconds) * course.rate_hz)
    return world, course.fly(rng, world, frames), rng


def record_course(folder: FilePath, course: Course, seed: int, seconds: float | None = None, flight: int = 0) -> None:
    """Fly a course and leave its recording in ``folder``; arguments as for `flown`.

    Raises:
        OutputError: If the folder cannot be written to.
    """
    world, path, rng = flown(course, seed, seconds, flight)
    record_flight(folder, world, path, rng, simulated_camera(), course.telemetry, course.faults, seed=seed + flight)
