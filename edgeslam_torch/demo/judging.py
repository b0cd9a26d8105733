"""The whole pipeline on a simulated recording, compared with the truth behind it."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.demo.flight import DemoSettings, Recorded
from edgeslam_torch.errors import OutputError
from edgeslam_torch.eval.inputs.run_folder import open_run
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import Listener, RunResult, run
from edgeslam_torch.synthetic.house.world import World

MAX_MAP_POINTS = 8_000
"""Maximum number of map points compared with the true surfaces, sampled with a fixed seed."""
SCORE = "demo.json"


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
        EvaluationError: If the trajectory is too short to compare (the run was interrupted at once).
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
        write_text(path, json.dumps(record_, indent=2, default=float) + "\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
