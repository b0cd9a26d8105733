"""Figures of a run for the judge: scale while flying, error at the return, and which frames the map supports.

The true metres per map unit follow from the live trajectory over the longest interval without a scale revision.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import associate, match
from edgeslam_torch.eval.inputs.run_folder import RunFolder, is_supported
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import travelled, umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, FrameStatus

FROM_S = 12.5
"""Ten seconds after the take-off of a simulated flight, which ends after 2.5 s."""
_SURE = 3.0
"""Stated sigmas."""
_LEAST_POSES = 20
_SENSORS = frozenset({"telemetry", "height"})
"""Sources of a scale that is measured, not guessed."""


def live_figures(run: RunFolder, truth: Trajectory) -> dict[str, float]:
    """Figures of the scale while flying.

    Returns:
        ``first_scale_s`` time until the output unit is the drone's metre, ``first_scale_off`` and
        ``first_scale_sigmas`` its log error then, absolute and in stated sigmas; ``beyond_3_sigma`` share of the frames
        after `FROM_S` whose scale is further off than three stated sigmas. Empty where no revision is long enough.
    """
    if run.online is None or not run.status:
        return {}
    stamps, value, unit = (np.array([float(row[k]) for row in run.status]) for k in ("stamp_s", "scale", "unit"))
    sigma = np.array([float(row.get("scale_sigma") or "inf") for row in run.status])
    revision = np.array([int(row["revision"]) for row in run.status])
    measured = np.array([not _SENSORS.isdisjoint(row.get("scale_source", "").split("+")) for row in run.status])
    numbers, first, counts = np.unique(revision, return_index=True, return_counts=True)
    longest = sorted(zip(-counts, first, numbers, strict=True))[0][2]
    stretch = revision == longest
    true = _true_scale(stamps[stretch], run.online, truth)
    if true is None:
        return {}
    true *= unit[stretch][0]
    figures = {}
    off, sigmas = np.log(value / true), sigma / value
    known = np.flatnonzero((revision > 0) & measured)
    if len(known):
        k = known[0]
        figures["first_scale_s"] = stamps[k] - stamps[0]
        figures["first_scale_off"] = abs(off[k])
        figures["first_scale_sigmas"] = abs(off[k]) / sigmas[k]
    later = stamps - stamps[0] >= FROM_S
    if later.any():
        figures["beyond_3_sigma"] = np.mean(np.abs(off[later]) > _SURE * sigmas[later])
    return {name: float(figure) for name, figure in figures.items()}


def _true_scale(stretch_s: np.ndarray, online: Trajectory, truth: Trajectory) -> float | None:
    """True metres per published unit, by the live poses of a time without a revision."""
    used = (online.stamps_s >= stretch_s[0] - 1e-6) & (online.stamps_s <= stretch_s[-1] + 1e-6)
    there, here = match(truth.stamps_s, online.stamps_s[used])
    if len(here) < _LEAST_POSES:
        return None
    try:
        found = umeyama(online.positions[used][here], truth.positions[there]).scale
    except EvaluationError:
        return None
    return found if found > 0 else None


MIN_WAY_M = 10.0
"""Way from a place back to it from which on it counts as a return."""
SAME_PLACE_M = 0.5


def return_error_percent(truth: Trajectory, estimate: Trajectory) -> float:
    """Median over all frames that return to a place, in % of the way since it was left; NaN where none returns.

    The difference of a frame's error and that of the frame nearest to it before the way, after Sim(3) alignment.

    Raises:
        EvaluationError: If the stamps do not match, or the estimate never moves.
    """
    i, j = associate(truth.stamps_s, estimate.stamps_s)
    p, q = truth.positions[i], estimate.positions[j]
    error = umeyama(q, p).points(q) - p
    way = travelled(p)
    found = []
    for k in range(len(p)):
        before = np.searchsorted(way, way[k] - MIN_WAY_M, side="right")
        if before == 0:
            continue
        apart = np.linalg.norm(p[:before] - p[k], axis=1)
        nearest = int(apart.argmin())
        if apart[nearest] <= SAME_PLACE_M:
            found.append(np.linalg.norm(error[k] - error[nearest]) / (way[k] - way[nearest]))
    return 100.0 * float(np.median(found)) if found else float("nan")


def returns(truth: Trajectory, run: Trajectory, online: Trajectory | None) -> dict[str, float]:
    """Figures of a run's refined and live trajectory; empty where they cannot be compared."""
    try:
        refined = return_error_percent(truth, run)
        live = float("nan") if online is None else return_error_percent(truth, online)
    except EvaluationError:
        return {}
    return {"return_percent": refined, "return_online_percent": live}


MIN_POINTS = 30
"""Minimum number of points of the delivered map in view of a supported frame."""
_SAMPLE = 10_000
"""Maximum number of sampled map points."""
_NEAREST_SHARE = 1e-3
"""Points nearer than this share of the map's median distance are not in view."""

Status = Sequence[dict[str, str]]


def live(rows: Status) -> NDArray[np.bool_]:
    """Frames ``(F,)`` of ``status.csv`` whose live pose was supported by the map."""
    supported = {str(status) for status in FrameStatus if status.supported}
    return np.array([row.get("status") in supported for row in rows], dtype=bool)


def at_end(rows: Status, T_w_c: FloatArray, p_w: FloatArray, camera: Camera) -> NDArray[np.bool_]:
    """Frames ``(F,)`` stated as supported whose final pose ``(F, 4, 4)`` has `MIN_POINTS` of the delivered points
    ``(P, 3)`` in view; lens distortion is neglected."""
    said = np.array([is_supported(row) for row in rows], dtype=bool)
    return said & (points_in_view(T_w_c, p_w, camera) >= MIN_POINTS)


def points_in_view(T_w_c: FloatArray, p_w: FloatArray, camera: Camera) -> NDArray[np.int64]:
    """Points in front of each camera and inside its image, ``(F,)``; of a large map, of `_SAMPLE` of its points."""
    p = np.asarray(p_w, dtype=np.float64)
    if len(p) > _SAMPLE:
        p = p[np.random.default_rng(0).choice(len(p), _SAMPLE, replace=False)]
    seen = np.zeros(len(T_w_c), dtype=np.int64)
    if len(p) == 0:
        return seen
    for i, T_c_w in enumerate(se3.inverse(T_w_c)):
        p_c = se3.transform(T_c_w, p)
        p_c = p_c[p_c[:, 2] > _NEAREST_SHARE * np.median(np.abs(p_c[:, 2]))]
        uv = camera.project(p_c)
        seen[i] = int(np.sum(((uv >= -0.5) & (uv <= [camera.width - 0.5, camera.height - 0.5])).all(axis=1)))
    return seen
