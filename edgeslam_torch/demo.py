"""The demo: a simulated drone in a simulated house, processed by the whole pipeline and compared with the truth."""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.eval.inputs.run_folder import open_run
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import Listener, RunResult, run
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ, SECONDS, record_flight, simulated_camera
from edgeslam_torch.synthetic.flights.degrade import CLEAN, CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults
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
MAX_MAP_POINTS = 8_000
"""Maximum number of map points compared with the true surfaces, sampled with a fixed seed."""
SCORE = "demo.json"


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
class MapAccuracy:
    """Distance of edge-map points to the true surfaces, after the trajectory's own alignment."""

    points: int
    median_m: float
    p90_m: float
    within_5cm: float
    """Share of the points."""


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo found."""

    recording: Path
    run: RunResult
    score: RunScore
    map: MapAccuracy | None
    """None when the map is empty."""
    path_m: float
    """Length of the true path."""
    render_s: float


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
    flight = course.pilot(rng, world, settings.frames, rate_hz=settings.rate_hz)
    record_flight(
        folder,
        world,
        flight,
        rng,
        settings.camera,
        settings.telemetry,
        CAMERAS[settings.images],
        seed=settings.seed,
        threads=min(4, os.cpu_count() or 1),
        on_frame=on_frame,
    )
    return Recorded(folder, world, flight, time.perf_counter() - start)


def run_and_judge(
    out: Path,
    recorded: Recorded,
    settings: DemoSettings,
    config: SlamConfig | None = None,
    listeners: Sequence[Listener] = (),
) -> DemoResult:
    """Run the pipeline on a simulated recording into ``out`` and compare the result with the truth.

    Raises:
        OutputError: If the folder cannot be written to.
        EvaluationError: If there is no trajectory to speak of (the run was interrupted at once).
    """
    result = run(open_source(str(recorded.folder)), Path(out), config, listeners=listeners)
    score = evaluate_run(out, recorded.folder, judge_map=False)
    path_m = float(np.linalg.norm(np.diff(recorded.flight.T_w_c[:, :3, 3], axis=0), axis=1).sum())
    accuracy = map_accuracy(out, score, recorded.world)
    demo = DemoResult(recorded.folder, result, score, accuracy, path_m, recorded.render_s)
    write_score(Path(out) / SCORE, demo, settings)
    return demo


def map_accuracy(out: Path, score: RunScore, world: World) -> MapAccuracy | None:
    """Compare ``edge_map.ply`` with the world's surfaces."""
    cloud = open_run(out).cloud()
    if cloud is None or len(cloud.p_w) == 0 or score.sim3 is None:
        return None
    p = cloud.p_w.astype(np.float64)
    if len(p) > MAX_MAP_POINTS:
        p = p[np.random.default_rng(0).choice(len(p), MAX_MAP_POINTS, replace=False)]
    distance = world.distance_to_surface(score.sim3.alignment.points(p))
    return MapAccuracy(
        len(cloud.p_w),
        float(np.median(distance)),
        float(np.percentile(distance, 90)),
        float(np.mean(distance < 0.05)),
    )


def write_score(path: Path, demo: DemoResult, settings: DemoSettings) -> None:
    """Write ``demo.json``: what was flown and how it came out.

    Raises:
        OutputError: If it cannot be written.
    """
    record_: dict[str, Any] = {
        "settings": asdict(settings),
        "frames": settings.frames,
        "path_m": demo.path_m,
        "render_s": demo.render_s,
        "trajectory": demo.score.to_dict(),
        "map": asdict(demo.map) if demo.map is not None else None,
    }
    try:
        path.write_text(json.dumps(record_, indent=2, default=float) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def _clear(recording: Path) -> None:
    """Take away the images of an older demo: a shorter flight must not keep the longer one's."""
    try:
        for folder in ("rgb", "depth"):
            for file in sorted((recording / folder).glob("*.*")):
                if file.suffix in (".jpg", ".png"):
                    file.unlink()
        (recording / "telemetry.csv").unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{recording}: an older demo there cannot be replaced ({error.strerror or error})") from error
