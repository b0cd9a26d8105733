"""The figures of one run: a new one is a function in `METRICS`, and a line in `COLUMNS` that shows and compares it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.figures import Figure, plain
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.eval.metrics.align import rms, travelled
from edgeslam_torch.eval.metrics.run_figures import at_end, live, live_figures, returns
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.geometry.camera_file import load_camera
from edgeslam_torch.types import FloatArray

MAP_THRESHOLDS_M = (0.02, 0.05, 0.06, 0.10)
"""Distances to the surface at which the map's share of points is taken."""
_MAX_POINTS = 20_000
"""Points compared with a simulated world's surfaces, drawn with a fixed seed."""
_BEGIN_S = 1.0
"""Length of a run's beginning."""

Figures = dict[str, float | None]
Surfaces = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a run."""

    poses: Path | None
    """Data set folder or trajectory file; None when there is nothing to compare with."""
    has_depth: bool = False
    """Whether depth maps of the data set judge the map."""
    surfaces: Surfaces | None = None
    """Distances ``(N,)`` [m] of points ``(N, 3)`` to the surfaces of a simulated world, instead of depth maps."""


def score(run_dir: Path, truth: Truth) -> tuple[Figures, list[str]]:
    """Figures of a run and remarks; unavailable figures are None.

    Raises:
        EvaluationError: If the folder holds no run.
    """
    run = open_run(run_dir)
    figures: dict[str, Any] = _own_figures(run)
    notes: list[str] = []
    if truth.poses is not None:
        try:
            found = evaluate_run(run.path, truth.poses, judge_map=truth.has_depth, thresholds_m=MAP_THRESHOLDS_M)
            for metric in METRICS:
                figures |= metric(run, found)
            figures |= _map(run, found, truth.surfaces)
            notes += [found.map_note] if truth.has_depth and found.map is None else []
        except EvaluationError as error:
            notes.append(str(error).removeprefix(f"{run.trajectory.source}: "))
            figures |= _standing_still(run, truth.poses)
    return plain(figures), notes


def _own_figures(run: RunFolder) -> dict[str, Any]:
    """Figures from the run's own output."""
    summary = run.summary
    clouds = [cloud for name in ("edge_map.ply", "anchors.ply") if (cloud := run.cloud(name)) is not None]
    p_w = np.concatenate([c.p_w for c in clouds]) if clouds else np.zeros((0, 3))
    offered = max(int(summary.get("frames", 0)) + int(summary.get("left_out", 0)), 1)
    counts, sources = summary.get("map") or {}, str(run.scale.get("source", "")).split("+")
    supported = at_end(run.pose_rows, run.trajectory.T_w_c, p_w, load_camera(run.path / "camera.yaml"))
    return {
        "frames": summary.get("frames"),
        "supported_end": np.sum(supported) / offered,
        "supported_live": np.sum(live(run.status)) / offered,
        "losses": summary.get("lost_events"),
        "pieces": sum(piece["supported"] > 0 for piece in summary.get("pieces") or ()),
        "metric": float(run.units == "metres"),
        "scale_sigma": run.scale_sigma or None,
        "by_telemetry": float("telemetry" in sources or "height" in sources),
        "said": float(any("telemetry" in warning for warning in summary.get("warnings") or ())),
        "map_points": counts.get("edge_points"),
        "anchors": counts.get("anchors"),
        "wall_s": summary.get("duration_s"),
        "memory_mb": summary.get("peak_rss_mb"),
    }


def _trajectory(_: RunFolder, found: RunScore) -> dict[str, Any]:
    path_m = found.sim3.truth_path_m
    return {
        "ate_m": found.ate_sim3_m,
        "online_m": found.ate_online_sim3_m,
        "ate_percent": _percent(found.ate_sim3_m, path_m),
        "online_percent": _percent(found.ate_online_sim3_m, path_m),
        "rotation_deg": found.rotation_deg,
        "se3_m": found.ate_se3_m if found.units == "metres" else None,
        "still_m": found.fixed_position_m,
        "path_m": path_m,
    }


def _percent(error_m: float, path_m: float) -> float | None:
    return 100.0 * error_m / path_m if path_m > 0 else None


def _scale(run: RunFolder, score: RunScore) -> dict[str, Any]:
    scale, sigma = score.sim3.scale, run.scale_sigma
    found = {"scale": scale if score.units == "metres" else None, "scale_sim3": scale}
    if not sigma > 0 or scale <= 0:
        return found | dict.fromkeys(("scale_z", "scale_off", "scale_sigmas"))
    off = np.log(scale)
    return found | {"scale_z": off / sigma, "scale_off": abs(off), "scale_sigmas": abs(off) / sigma}


def _beginning(_: RunFolder, score: RunScore) -> dict[str, Any]:
    """RMS error of the first second's poses [m], and its ratio to that of the others."""
    first = score.sim3.stamps_s < score.sim3.stamps_s[0] + _BEGIN_S
    if first.all():
        return {"first_m": None, "first_over_rest": None}
    begin, rest = (float(np.sqrt(np.mean(score.sim3.error_m[k] ** 2))) for k in (first, ~first))
    return {"first_m": begin, "first_over_rest": begin / rest if rest > 0 else None}


def _map(run: RunFolder, score: RunScore, surfaces: Surfaces | None) -> dict[str, Any]:
    found, cloud = score.map, run.cloud()
    if found is not None:
        return {
            "map_median_m": found.median_m,
            "map_within_5cm": found.accuracy[0.05],
            "map_within_10cm": found.accuracy[0.10],
            "map_judged": found.judged_share,
        }
    if surfaces is None or cloud is None or len(cloud.p_w) == 0:
        return {}
    p: FloatArray = cloud.p_w.astype(np.float64)
    if len(p) > _MAX_POINTS:
        p = p[np.random.default_rng(0).choice(len(p), _MAX_POINTS, replace=False)]
    distance = surfaces(score.sim3.alignment.points(p))
    within = {f"map_within_{round(100 * t)}cm": np.mean(distance <= t) for t in (0.05, 0.10)}
    return {"map_median_m": np.median(distance), **within, "map_judged": 1.0}


METRICS: tuple[Callable[[RunFolder, RunScore], Mapping[str, Any]], ...] = (
    _trajectory,
    _scale,
    _beginning,
    lambda run, score: live_figures(run, score.truth),
    lambda run, score: returns(score.truth, run.trajectory, run.online),
)
"""Figures of a run with ground truth."""


COLUMNS = (
    Figure("frames", "frames", "{:.0f}"),
    Figure("supported_end", "end %", "{:.1f}", 100.0, floor=0.005, relative=False, lower_is_better=False),
    Figure(
        "supported_live", "live %", "{:.1f}", 100.0, floor=0.005, one_seed=0.01, relative=False, lower_is_better=False
    ),
    Figure("losses", "lost", "{:.0f}", floor=0.5, relative=False),
    Figure("pieces", "pieces", "{:.0f}"),
    Figure("ate_m", "ATE", spread=True, floor=0.03, one_seed=0.05),
    Figure("online_m", "online", spread=True, floor=0.03, one_seed=0.16),
    Figure("ate_percent", "path %", "{:.2f}"),
    Figure("return_percent", "return %", "{:.2f}"),
    Figure("rotation_deg", "rot °", "{:.2f}", floor=0.03, one_seed=0.28),
    Figure("scale", "scale", "{:.3f}"),
    Figure("scale_sigma", "sigma %", "{:.1f}", 100.0),
    Figure("scale_z", "z", "{:+.1f}"),
    Figure("first_scale_s", "1st scale s", "{:.1f}"),
    Figure("first_scale_sigmas", "its z", "{:.1f}"),
    Figure("beyond_3_sigma", ">3 sigma %", "{:.0f}", 100.0),
    Figure("se3_m", "SE(3)"),
    Figure("still_m", "still", "{:.3f}"),
    Figure("first_m", "1st s"),
    Figure("first_over_rest", "x rest", "{:.1f}"),
    Figure("map_points", "points", "{:.0f}", floor=0.05, lower_is_better=False),
    Figure("map_median_m", "median cm", "{:.2f}", 100.0, floor=0.03, one_seed=0.80),
    Figure(
        "map_within_5cm", "5 cm %", "{:.0f}", 100.0, floor=0.02, one_seed=0.08, relative=False, lower_is_better=False
    ),
    Figure("map_within_10cm", "10 cm %", "{:.0f}", 100.0),
    Figure("cpu_ms", "CPU ms", "{:.1f}", floor=0.10),
    Figure("cpu_orb", "CPU ORB", "{:.1f}"),
    Figure("wall_s", "wall s", "{:.1f}"),
    Figure("memory_mb", "MB", "{:.0f}"),
)
"""Floors for one seed are two standard deviations of a difference of two runs, measured with three seeds on two
recordings (tum_fr1_xyz, 7scenes_redkitchen); recordings with tracking losses scatter more."""


def _standing_still(run: RunFolder, place: Path) -> dict[str, Any]:
    """Errors of a run that never moved: those of the best fixed position; empty for one that did."""
    if float(np.ptp(run.trajectory.positions, axis=0).max()) > 0:
        return {}
    poses = open_dataset(place).truth if place.is_dir() else read_trajectory(place)
    matched = poses.positions[match(poses.stamps_s, run.trajectory.stamps_s)[0]]
    if len(matched) == 0:
        return {}
    still = rms(matched - matched.mean(axis=0))
    path = float(travelled(matched)[-1])
    percent = _percent(still, path)
    return {"ate_m": still, "online_m": still, "ate_percent": percent, "still_m": still, "path_m": path}
