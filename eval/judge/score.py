"""The figures of one run, as the table shows them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory
from edgeslam_torch.eval.judge import support
from edgeslam_torch.eval.judge.telemetry.live_scale import live_figures
from edgeslam_torch.eval.metrics.revisit import returns
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore
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
"""Distances ``(N,)`` [m] of points ``(N, 3)`` to the true surfaces."""


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of a run."""

    poses: Path | None
    """Data set folder or trajectory file; None when there is nothing to compare with."""
    depth: Path | None = None
    """Data set whose depth maps judge the map."""
    surfaces: Surfaces | None = None
    """Of a simulated world, instead of depth maps."""


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
            figures |= _against_truth(run, truth, notes)
        except EvaluationError as error:
            notes.append(str(error).removeprefix(f"{run.trajectory.source}: "))
            figures |= _standing_still(run, truth.poses)
    return {k: float(v) if v is not None and np.isfinite(v) else None for k, v in figures.items()}, notes


def _own_figures(run: RunFolder) -> dict[str, Any]:
    """Figures from the run's own output."""
    summary = run.summary
    clouds = [cloud for name in ("edge_map.ply", "anchors.ply") if (cloud := run.cloud(name)) is not None]
    p_w = np.concatenate([c.p_w for c in clouds]) if clouds else np.zeros((0, 3))
    offered = max(int(summary.get("frames", 0)) + int(summary.get("left_out", 0)), 1)
    camera = load_camera(run.path / "camera.yaml")
    counts = summary.get("map") or {}
    scale = summary.get("scale") or {}
    sigma = scale.get("sigma")
    sources = str(scale.get("source", "")).split("+")
    return {
        "frames": summary.get("frames"),
        "supported_end": np.sum(support.at_end(run.pose_rows, run.trajectory.T_w_c, p_w, camera)) / offered,
        "supported_live": np.sum(support.live(run.status)) / offered,
        "losses": summary.get("lost_events"),
        "pieces": sum(piece["supported"] > 0 for piece in summary.get("pieces") or ()),
        "metric": float(scale.get("units") == "metres"),
        "scale_sigma": float(sigma) / float(scale["value"]) if sigma else None,
        "by_telemetry": float("telemetry" in sources or "height" in sources),
        "said": float(any("telemetry" in warning for warning in summary.get("warnings") or ())),
        "map_points": counts.get("edge_points"),
        "anchors": counts.get("anchors"),
        "wall_s": summary.get("duration_s"),
        "memory_mb": summary.get("peak_rss_mb"),
    }


def _against_truth(run: RunFolder, truth: Truth, notes: list[str]) -> dict[str, Any]:
    assert truth.poses is not None
    judge_map = truth.surfaces is None and truth.depth is not None
    found = evaluate_run(run.path, truth.poses, truth.depth, judge_map=judge_map, thresholds_m=MAP_THRESHOLDS_M)
    assert found.sim3 is not None
    scale = found.sim3.scale
    sigma = _own_sigma(run)
    off = np.log(scale) if scale > 0 else None
    figures = {
        "ate_m": found.ate_sim3_m,
        "online_m": found.ate_online_sim3_m,
        "ate_percent": 100.0 * found.ate_sim3_m / found.sim3.truth_path_m if found.sim3.truth_path_m > 0 else None,
        "online_percent": _percent(found.ate_online_sim3_m, found.sim3.truth_path_m),
        "rotation_deg": found.rotation_deg,
        "se3_m": found.ate_se3_m if found.units == "metres" else None,
        "scale": scale if found.units == "metres" else None,
        "scale_sim3": scale,
        "scale_z": off / sigma if sigma is not None and off is not None else None,
        "scale_off": abs(off) if sigma is not None and off is not None else None,
        "scale_sigmas": abs(off) / sigma if sigma is not None and off is not None else None,
        "still_m": found.fixed_position_m,
        "path_m": found.sim3.truth_path_m,
        "first_m": _beginning(found.sim3)[0],
        "first_over_rest": _beginning(found.sim3)[1],
    }
    figures |= live_figures(run, _poses(truth.poses))
    figures |= returns(_poses(truth.poses), run.trajectory, run.online)
    figures |= _map_figures(run, found, truth.surfaces)
    if judge_map and found.map is None:
        notes.append(found.map_note)
    return figures


def _percent(error_m: float, path_m: float) -> float | None:
    return 100.0 * error_m / path_m if path_m > 0 else None


def _own_sigma(run: RunFolder) -> float | None:
    """Standard deviation of log scale that the run states."""
    scale = run.summary.get("scale") or {}
    return float(scale["sigma"]) / float(scale["value"]) if scale.get("sigma") else None


def _beginning(found: TrajectoryScore) -> tuple[float, float]:
    """RMS error of the first second's poses [m], and its ratio to that of the others."""
    first = found.stamps_s < found.stamps_s[0] + _BEGIN_S
    if first.all():
        return float("nan"), float("nan")
    begin, rest = (float(np.sqrt(np.mean(found.error_m[k] ** 2))) for k in (first, ~first))
    return begin, begin / rest if rest > 0 else float("nan")


def _map_figures(run: RunFolder, found: RunScore, surfaces: Surfaces | None) -> dict[str, Any]:
    if found.map is not None:
        return {
            "map_median_m": found.map.median_m,
            "map_within_5cm": found.map.accuracy[0.05],
            "map_within_10cm": found.map.accuracy[0.10],
            "map_judged": found.map.judged_share,
        }
    cloud = run.cloud()
    if surfaces is None or cloud is None or len(cloud.p_w) == 0 or found.sim3 is None:
        return {}
    p: FloatArray = cloud.p_w.astype(np.float64)
    if len(p) > _MAX_POINTS:
        p = p[np.random.default_rng(0).choice(len(p), _MAX_POINTS, replace=False)]
    distance = surfaces(found.sim3.alignment.points(p))
    return {
        "map_median_m": np.median(distance),
        "map_within_5cm": np.mean(distance <= 0.05),
        "map_within_10cm": np.mean(distance <= 0.10),
        "map_judged": 1.0,
    }


def _poses(truth: Path) -> Trajectory:
    return open_dataset(truth).truth if truth.is_dir() else read_trajectory(truth)


def _standing_still(run: RunFolder, truth: Path) -> dict[str, Any]:
    """Errors of a run that never moved: those of the best fixed position; empty for one that did."""
    if float(np.ptp(run.trajectory.positions, axis=0).max()) > 0:
        return {}
    poses = _poses(truth)
    matched = poses.positions[match(poses.stamps_s, run.trajectory.stamps_s)[0]]
    if len(matched) == 0:
        return {}
    still = np.sqrt(np.mean(np.sum((matched - matched.mean(axis=0)) ** 2, axis=1)))
    path = np.linalg.norm(np.diff(matched, axis=0), axis=1).sum()
    percent = _percent(float(still), float(path))
    return {"ate_m": still, "online_m": still, "ate_percent": percent, "still_m": still, "path_m": path}
