"""Evaluation of one run against its data set."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, in_order, on_one_clock
from edgeslam_torch.eval.inputs.dataset import EvalDataset, interpolate, open_dataset
from edgeslam_torch.eval.inputs.run_folder import RunFolder, is_supported, open_run, record
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, umeyama
from edgeslam_torch.eval.metrics.diagnose import explain
from edgeslam_torch.eval.metrics.edge_map_score import THRESHOLDS_M, MapScore, score_map, surface_truth
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore, score_trajectory, without_orientation
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class RunScore:
    """All scores of one run; lengths in metres, angles in degrees."""

    name: str
    dataset: str
    ate_sim3_m: float
    """ATE RMSE after Sim(3), all poses of ``trajectory.txt``: what monocular systems are compared by."""
    ate_se3_m: float
    """ATE RMSE after SE(3): what a metric run is judged by."""
    ate_raw_m: float
    """ATE RMSE without any alignment: only for runs that share the truth's world frame."""
    ate_online_sim3_m: float
    """The same as the first for ``trajectory_online.txt``; NaN without one."""
    scale_error: float
    """``s - 1`` where ``s`` is what the estimate must be multiplied by."""
    scale_inside_95: bool | None
    """Whether the true scale lies inside the run's own 95 % interval; None when it states none."""
    coverage: float
    """Frames of the source whose pose rests on their own image (initialised, tracked, relocalised)."""
    with_pose: float
    """Frames of the source that have any pose."""
    first_pose_s: float
    """Time from the first image to the first pose."""
    matched: int
    rotation_deg: float
    """RMSE of the orientation after alignment."""
    rpe_1s_m: float
    rpe_1s_deg: float
    full_transform: float
    """RMSE of ``||E - I||_F``, unitless: the paper's figure."""
    fixed_position_m: float
    """ATE of the best fixed position."""
    map: MapScore | None
    map_note: str
    """Why there is no map score."""
    units: str
    """``metres`` or ``arbitrary``, as stated by the run; ``unknown`` for a bare trajectory."""
    summary: dict[str, Any]
    notes: tuple[str, ...]
    """Findings of `explain`."""
    sim3: TrajectoryScore = field(repr=False)
    """The full Sim(3) score."""
    truth: Trajectory = field(repr=False)
    """True poses."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings for JSON; None for a figure that there is not."""
        found = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("sim3", "truth")}
        found["map"] = None if self.map is None else asdict(self.map)
        found |= {name: [asdict(row) for row in getattr(self.sim3, name)] for name in ("relative", "drift")}
        found |= {"ate_sim3": asdict(self.sim3.ate_m), "rotation": asdict(self.sim3.rotation_deg)}
        plain: dict[str, Any] = finite(found | {"truth_path_m": self.sim3.truth_path_m})
        return plain


def evaluate_run(
    run_dir: Path | str,
    dataset_dir: Path | str,
    depth_truth_dir: Path | str | None = None,
    max_dt_s: float = DEFAULT_MAX_DT_S,
    offset_s: float = 0.0,
    judge_map: bool = True,
    thresholds_m: Sequence[float] = THRESHOLDS_M,
) -> RunScore:
    """Judge a run's output folder (or a bare trajectory file).

    Args:
        run_dir: Output folder of ``edgeslam run``, or a trajectory file.
        dataset_dir: Data set folder with ground truth, or a ground-truth trajectory file.
        depth_truth_dir: Data set whose depth maps judge the map; ``dataset_dir`` when not given.
        max_dt_s: Largest time between matched poses [s].
        offset_s: Added to the run's stamps [s].
        judge_map: Compare the edge map with the depth maps too.
        thresholds_m: Distances at which the map's shares are given [m].

    Raises:
        EvaluationError: If they cannot be compared; the message names the likely mistake.
    """
    run = open_run(run_dir)
    dataset_dir = Path(dataset_dir)
    dataset = open_dataset(dataset_dir) if dataset_dir.is_dir() else None
    truth = dataset.truth if dataset is not None else read_trajectory(dataset_dir)
    images_s = dataset.frame_stamps_s if dataset is not None else np.zeros(0)
    truth, trajectory = on_one_clock(truth, in_order(run.trajectory, images_s, "the data set's images"))
    run = replace(run, trajectory=trajectory)
    kinds = (AlignmentKind.SIM3, AlignmentKind.SE3, AlignmentKind.NONE)
    sim3, se3, raw = (score_trajectory(truth, trajectory, kind, max_dt_s, offset_s) for kind in kinds)
    online = float("nan")
    if run.online is not None:
        online = score_trajectory(truth, run.online, AlignmentKind.SIM3, max_dt_s, offset_s).ate_m.rmse
    depth_dataset = open_dataset(depth_truth_dir) if depth_truth_dir is not None else dataset
    map_score, map_note = _map_score(run, depth_dataset, sim3, thresholds_m) if judge_map else (None, "not requested")
    one_second = next((r for r in sim3.relative if r.delta == "1 s"), None)
    coverage, with_pose, first = _coverage(run, images_s, truth, offset_s)
    judged = se3 if run.units == "metres" else sim3
    return RunScore(
        name=run.name,
        dataset=dataset.name if dataset is not None else dataset_dir.name,
        ate_sim3_m=sim3.ate_m.rmse,
        ate_se3_m=se3.ate_m.rmse,
        ate_raw_m=raw.ate_m.rmse,
        ate_online_sim3_m=online,
        scale_error=sim3.scale - 1.0,
        scale_inside_95=abs(sim3.scale - 1.0) <= 1.96 * run.scale_sigma if run.scale_sigma > 0 else None,
        coverage=coverage,
        with_pose=with_pose,
        first_pose_s=first,
        matched=sim3.matched,
        rotation_deg=sim3.rotation_deg.rmse,
        rpe_1s_m=one_second.translation_m.rmse if one_second is not None else float("nan"),
        rpe_1s_deg=one_second.rotation_deg.rmse if one_second is not None else float("nan"),
        full_transform=sim3.full_transform.rmse,
        fixed_position_m=sim3.fixed_position_m,
        map=map_score,
        map_note=map_note,
        units=run.units,
        summary=run.summary,
        notes=tuple(explain(truth, run.trajectory, judged, max_dt_s)),
        sim3=sim3,
        truth=truth,
    )


def finite(value: Any) -> Any:
    """Nested numbers that are not finite as None: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, (float, np.floating)) and not np.isfinite(value):
        return None
    return value


def _map_score(
    run: RunFolder, dataset: EvalDataset | None, sim3: TrajectoryScore, thresholds_m: Sequence[float]
) -> tuple[MapScore | None, str]:
    if run.path.is_file():
        return None, "a trajectory alone has no map"
    cloud = run.cloud()
    if cloud is None:
        return None, f"{run.path}: no edge_map.ply"
    if dataset is None or dataset.depth is None:
        return None, "the data set has no depth maps"
    if without_orientation(dataset.truth, run.trajectory) is dataset.truth:
        return None, "the ground truth has no orientations, so where its depth maps lie is not known"
    truth = surface_truth(dataset.folder.resolve())
    alignment = sim3.alignment
    if not dataset.depth.is_registered:
        # The true poses are the depth camera's; the run's are the colour camera's, 2.6 cm beside it.
        T, known = interpolate(dataset.truth, run.trajectory.stamps_s)
        colour = T @ np.linalg.inv(dataset.depth.T_c_d)
        alignment = umeyama(run.trajectory.positions[known], colour[known, :3, 3])
    try:
        return score_map(cloud.p_w, alignment, truth, thresholds_m), ""
    except EvaluationError as error:
        return None, str(error)


def _coverage(run: RunFolder, frames: FloatArray, truth: Trajectory, offset_s: float) -> tuple[float, float, float]:
    """Share of frames with a trusted pose and with any pose, and the time of the first [s]."""
    limit = record(run.summary.get("source")).get("length")
    if isinstance(limit, int) and 0 < limit < len(frames):
        frames = frames[:limit]  # with --max-frames the run has fewer
    if len(frames) == 0:
        span = float(truth.stamps_s[-1] - truth.stamps_s[0])
        mine = run.trajectory.stamps_s + offset_s
        inside = mine[(mine >= truth.stamps_s[0] - 1.0) & (mine <= truth.stamps_s[-1] + 1.0)]
        share = min(1.0, float(inside[-1] - inside[0]) / span) if len(inside) > 1 and span > 0 else 0.0
        return share, share, float(inside[0] - truth.stamps_s[0]) if len(inside) else float("nan")
    count = len(frames)
    begin = max(float(frames[0]), float(run.status[0].get("stamp_s") or "nan")) if run.status else float(frames[0])
    rows = zip(run.pose_rows, run.trajectory.stamps_s, strict=True)
    first = next((stamp for row, stamp in rows if is_supported(row)), run.trajectory.stamps_s[0])
    trusted = min(1.0, run.trusted_frames / count)
    return trusted, min(1.0, len(run.trajectory) / count), float(first) + offset_s - begin
