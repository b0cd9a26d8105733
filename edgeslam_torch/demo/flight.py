"""A simulated flight in a simulated house, recorded as a folder."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.files.imu_files import MODEL, READINGS
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ, SECONDS, simulated_camera
from edgeslam_torch.synthetic.flights.degrade import CLEAN, CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight
from edgeslam_torch.synthetic.flights.imu import MPU6050
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults
from edgeslam_torch.synthetic.flights.writer import record_flight
from edgeslam_torch.synthetic.house.world import World

WORLDS = {name: COURSES[name] for name in ("room", "corridor", "block")}
"""What ``--world`` takes: where and how to fly."""
CAMERAS = {
    "clean": CLEAN,
    "normal": CameraFaults(),
    "poor": CameraFaults(
        exposure_amplitude=0.25,
        exposure_period_s=4.0,
        read_noise=3.0,
        shot_noise=0.35,
        vignetting=0.35,
        shutter_s=0.015,
    ),
}
"""Names of ``--images``."""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """Settings of the demo flight."""

    world: str = "room"
    seconds: float = SECONDS
    rate_hz: float = RATE_HZ
    seed: int = 0
    images: str = "normal"
    """A name in `CAMERAS`."""
    telemetry: TelemetryFaults | None = TelemetryFaults()
    """None flies without telemetry."""
    imu: bool = False
    """Whether the drone carries an IMU (MPU-6050 grade, 200 Hz)."""
    width: int = 640
    height: int = 480

    def __post_init__(self) -> None:
        if self.world not in WORLDS:
            raise ConfigError(f"no world {self.world!r}; there are {', '.join(WORLDS)}")
        if self.images not in CAMERAS:
            raise ConfigError(f"no image quality {self.images!r}; there are {', '.join(CAMERAS)}")
        if not (1.0 <= self.seconds <= 3600.0 and 5.0 <= self.rate_hz <= 120.0):
            raise ConfigError(f"give 1 to 3600 seconds at 5 to 120 Hz, not {self.seconds:g} s at {self.rate_hz:g} Hz")

    @property
    def frames(self) -> int:
        """Number of images."""
        return round(self.seconds * self.rate_hz)

    @property
    def camera(self) -> Camera:
        """A Tello's camera, without distortion, at the demo's size."""
        return simulated_camera(self.width, self.height)


@dataclass(frozen=True, slots=True)
class Recorded:
    """A simulated recording and the truth behind it."""

    folder: Path
    world: World
    flight: Flight
    render_s: float


def record(folder: Path, settings: DemoSettings, on_frame: Callable[[int], None] | None = None) -> Recorded:
    """Fly the simulated drone and leave its recording in ``folder`` (an older one there is replaced).

    Raises:
        OutputError: If the folder cannot be written to.
    """
    _clear(folder)
    start = time.perf_counter()
    rng = np.random.default_rng(settings.seed)
    course = WORLDS[settings.world]
    world = course.world(rng)
    flight = course.fly(rng, world, settings.frames, settings.rate_hz)
    record_flight(
        folder,
        world,
        flight,
        rng,
        settings.camera,
        settings.telemetry,
        CAMERAS[settings.images],
        seed=settings.seed,
        imu=MPU6050 if settings.imu else None,
        threads=min(4, os.cpu_count() or 1),
        on_frame=on_frame,
    )
    return Recorded(folder, world, flight, time.perf_counter() - start)


def _is_demo(recording: Path) -> bool:
    try:
        camera = read_mapping(recording / "camera.yaml", "YAML", OutputError)
        return bool(camera.get("source") == simulated_camera().source)
    except OutputError:
        return False


def _clear(recording: Path) -> None:
    """Remove the images of an older demo: a shorter flight must not keep the longer one's.

    Raises:
        OutputError: If the folder holds something else.
    """
    if recording.is_dir() and any(recording.iterdir()) and not _is_demo(recording):
        raise OutputError(f"{recording}: holds what no demo recorded; give another folder to --out")
    try:
        for folder in ("rgb", "depth"):
            for file in sorted((recording / folder).glob("*.*")):
                if file.suffix in (".jpg", ".png"):
                    file.unlink()
        for name in ("telemetry.csv", READINGS, MODEL):
            (recording / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{recording}: an older demo there cannot be replaced ({error.strerror or error})") from error
