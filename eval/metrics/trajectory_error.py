"""Trajectory error: ATE/APE, RPE and drift under no, SE(3) or Sim(3) alignment.

Figures agree with evo 1.38 (the test compares them): APE of a pose is ``E = T_truth^-1 T_estimate`` after alignment;
its translation part is ATE, its rotation angle APE's rotation, and ``||E - I||_F`` the "full transform, unitless"
that the paper prints as its 0.046 (eq. 30 without the lost ``- I``). RPE is Sturm et al. 2012, eq. 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, associate, nearest, on_one_clock
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import Alignment, AlignmentKind, any_offset, rms, travelled, umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import angles
from edgeslam_torch.types import FloatArray, IntArray

DRIFT_SEGMENTS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Lengths of path over which drift is given; those longer than the sequence are left out."""

_STILL_M, _JITTER_M = 1e-5, 1e-3
"""RMS distance from its mean below which a truth does not move: at all, or by a tracker's jitter alone (tenths of a
millimetre, consecutive poses as far apart as any two)."""

_TURNED_ALIKE_DEG, _TURNING_DEG = 0.1, 2.0
"""All orientations of a file within the first while the other file turns by the second: they were left out."""

_PATH_TOLERANCE = 0.1
"""A pair of poses counts for 1 m when the path between them is 1 m within this fraction (evo's default)."""


@dataclass(frozen=True, slots=True)
class Stats:
    """Summary of one kind of error over all pairs."""

    rmse: float
    mean: float
    median: float
    std: float
    max: float

    @staticmethod
    def of(errors: FloatArray) -> "Stats":
        """Statistics of errors ``(N,)``; NaN when there are none."""
        if len(errors) == 0:
            return Stats(*[float("nan")] * 5)
        rmse = np.sqrt(np.mean(errors**2))
        return Stats(*map(float, (rmse, np.mean(errors), np.median(errors), np.std(errors), np.max(errors))))


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Error of the motion between two poses."""

    delta: str
    """What lies between them: ``1 frame``, ``1 s``, ``1 m``."""
    pairs: int
    translation_m: Stats
    rotation_deg: Stats


@dataclass(frozen=True, slots=True)
class Drift:
    """Mean relative error over all segments of one length."""

    segment_m: float
    segments: int
    translation_percent: float
    rotation_deg_per_m: float


@dataclass(frozen=True, slots=True)
class TrajectoryScore:
    """Everything `score_trajectory` finds about one estimate under one alignment."""

    alignment: Alignment
    pairs: tuple[IntArray, IntArray]
    """Indices ``(M,)`` of the matched poses, true and estimated."""
    offset_s: float
    """Added to the estimate's stamps before matching."""
    ate_m: Stats
    """Distance of aligned positions [m]."""
    rotation_deg: Stats
    """Angle between aligned orientations [deg]."""
    full_transform: Stats
    """``||T_truth^-1 T_estimate - I||_F``: unitless, mixes metres with rotation; for comparison with the paper."""
    relative: tuple[RelativeError, ...]
    """Empty, as is `drift`, and rotations NaN, where one of the two files has no orientations."""
    drift: tuple[Drift, ...]
    scale: float
    """What the estimate must be multiplied by to have the truth's size (from Sim(3), whatever the alignment)."""
    matched: int
    truth_path_m: float
    """Length of the matched true path."""
    fixed_position_m: float
    """ATE that a camera standing still at the best place would score: what any figure must be compared with."""
    stamps_s: FloatArray
    """``(M,)`` true stamps of the matched poses."""
    error_m: FloatArray
    """``(M,)`` distance of each matched pose."""
    error_deg: FloatArray
    """``(M,)`` angle of each matched pose."""


def score_trajectory(
    truth: Trajectory,
    estimate: Trajectory,
    alignment: AlignmentKind | str = AlignmentKind.SIM3,
    max_dt_s: float = DEFAULT_MAX_DT_S,
    offset_s: float = 0.0,
) -> TrajectoryScore:
    """Error of ``estimate`` against ``truth``.

    Args:
        truth: Ground truth, camera to world [m].
        estimate: Trajectory to judge.
        alignment: Freedom given before comparing: ``none``, ``se3`` (metric runs) or ``sim3`` (monocular runs).
        max_dt_s: Largest time between matched poses [s].
        offset_s: Added to the estimate's stamps [s].

    Raises:
        EvaluationError: If the two cannot be compared.
    """
    truth, estimate = on_one_clock(truth, estimate)
    try:
        i, j = associate(truth.stamps_s, estimate.stamps_s + offset_s, max_dt_s)
    except EvaluationError as reason:
        hints = "".join(f"; {hint}" for hint in _clock_hints(truth, estimate))
        raise EvaluationError(f"{estimate.source} against {truth.source}: {reason}{hints}") from reason
    if len(i) < 2:
        raise EvaluationError(f"{estimate.source}: {len(i)} pose has ground truth; a trajectory needs at least 2")
    stamps, T_true, T_raw = truth.stamps_s[i], truth.T_w_c[i], estimate.T_w_c[j]
    centred = T_true[:, :3, 3] - T_true[:, :3, 3].mean(axis=0)
    fixed_position_m = rms(centred)
    path_m = float(travelled(T_true[:, :3, 3])[-1])
    jitter = fixed_position_m < _JITTER_M and path_m > 0.5 * len(i) * fixed_position_m
    if fixed_position_m < _STILL_M or jitter:
        raise EvaluationError(
            f"{truth.source}: the ground truth never moves ({1000 * fixed_position_m:.2g} mm about its mean over the "
            f"{len(i)} matched poses): nothing to compare with"
        )
    try:
        found = umeyama(T_raw[:, :3, 3], T_true[:, :3, 3], alignment)
    except EvaluationError as reason:
        raise EvaluationError(f"{estimate.source}: {reason}") from reason
    scale = found.scale if found.kind is AlignmentKind.SIM3 else _scale(T_raw[:, :3, 3], T_true[:, :3, 3])
    T = found.poses(T_raw)
    error = se3.inverse(T_true) @ T
    error_m = np.linalg.norm(error[:, :3, 3], axis=1)
    oriented = without_orientation(truth, estimate) is None
    if not oriented:
        error = np.full_like(error, np.nan)
    error_deg = _angle_deg(error)
    return TrajectoryScore(
        alignment=found,
        pairs=(i, j),
        offset_s=offset_s,
        ate_m=Stats.of(error_m),
        rotation_deg=Stats.of(error_deg),
        full_transform=Stats.of(np.linalg.norm(error - np.eye(4), axis=(1, 2))),
        relative=relative_errors(T_true, T, stamps, max_dt_s) if oriented else (),
        drift=drift(T_true, T) if oriented else (),
        scale=scale,
        matched=len(i),
        truth_path_m=path_m,
        fixed_position_m=fixed_position_m,
        stamps_s=stamps,
        error_m=error_m,
        error_deg=error_deg,
    )


def without_orientation(truth: Trajectory, estimate: Trajectory) -> Trajectory | None:
    """The one of the two without usable orientations: it has positions alone, or one orientation for
    all poses while the other one's camera turns."""
    for mine, other in ((truth, estimate), (estimate, truth)):
        if not mine.oriented or (_spread_deg(mine) < _TURNED_ALIKE_DEG and _spread_deg(other) > _TURNING_DEG):
            return mine
    return None


def _spread_deg(trajectory: Trajectory) -> float:
    """Largest angle [deg] between the first orientation and another."""
    R = trajectory.T_w_c[:, :3, :3]
    return float(np.degrees(angles(R[0].T @ R).max()))


def _clock_hints(truth: Trajectory, estimate: Trajectory) -> list[str]:
    """What else is known when no stamps match: how they were made up, and the offset that the shapes ask for."""
    hints = [f"{t.source}: {note}" for t in (truth, estimate) for note in t.notes]
    found = any_offset(truth, estimate)
    if found.share < 0.2:
        hints.append(f"the shapes fit best with --offset {found.shift_s:.2f} (ATE {found.ate_m:.3f} m)")
    elif 0.5 < found.share < np.inf:
        hints.append("no offset makes the shapes fit: probably another sequence")
    return hints


def relative_errors(
    T_true: FloatArray, T: FloatArray, stamps_s: FloatArray, max_dt_s: float
) -> tuple[RelativeError, ...]:
    """RPE over one frame, one second and one metre of the true path, all pairs."""
    n = len(stamps_s)
    frames = np.arange(n - 1), np.arange(1, n)
    later = nearest(stamps_s, stamps_s + 1.0)
    ok = np.abs(stamps_s[later] - stamps_s - 1.0) <= max_dt_s
    seconds = np.flatnonzero(ok), later[ok]
    return tuple(
        _relative(name, T_true, T, i, j)
        for name, (i, j) in (("1 frame", frames), ("1 s", seconds), ("1 m", pairs_by_path(T_true, 1.0)))
    )


def pairs_by_path(T: FloatArray, delta_m: float) -> tuple[IntArray, IntArray]:
    """All pairs ``(i, j)`` of poses whose path length is nearest to ``delta_m``, and within 10 % of it."""
    path = travelled(T[:, :3, 3])
    i = np.arange(len(path) - 1)
    j = np.maximum(nearest(path, path[i] + delta_m), i + 1)
    # Where the camera stands still several poses have the same path; the first of them, as evo takes it.
    j = np.maximum(np.searchsorted(path, path[j]), i + 1)
    ok = np.abs(path[j] - path[i] - delta_m) <= _PATH_TOLERANCE * delta_m
    return i[ok], j[ok]


def drift(T_true: FloatArray, T: FloatArray) -> tuple[Drift, ...]:
    """Translation drift [% of the path] and rotation drift [deg/m] over segments of several lengths."""
    out = []
    for length in DRIFT_SEGMENTS_M:
        i, j = pairs_by_path(T_true, length)
        if len(i) == 0:
            continue
        r = _relative("", T_true, T, i, j)
        out.append(Drift(length, r.pairs, 100.0 * r.translation_m.mean / length, r.rotation_deg.mean / length))
    return tuple(out)


def _relative(name: str, T_true: FloatArray, T: FloatArray, i: IntArray, j: IntArray) -> RelativeError:
    motion_true = se3.inverse(T_true[i]) @ T_true[j]
    error = se3.inverse(motion_true) @ (se3.inverse(T[i]) @ T[j])
    return RelativeError(name, len(i), Stats.of(np.linalg.norm(error[:, :3, 3], axis=1)), Stats.of(_angle_deg(error)))


def _angle_deg(T: FloatArray) -> FloatArray:
    if len(T) == 0 or not np.isfinite(T).all():
        return np.full(len(T), np.nan)
    return np.degrees(angles(T[:, :3, :3]))


def _scale(estimate: FloatArray, truth: FloatArray) -> float:
    try:
        return umeyama(estimate, truth, AlignmentKind.SIM3).scale
    except EvaluationError:
        return float("nan")


@dataclass(frozen=True, slots=True)
class CommonScore:
    """One trajectory, judged on the frames that all have."""

    name: str
    frames: int
    """Poses that it has itself."""
    sim3: TrajectoryScore
    se3: TrajectoryScore


def score_common(
    truth: Trajectory,
    estimates: Sequence[tuple[str, Trajectory]],
    max_dt_s: float = DEFAULT_MAX_DT_S,
    offset_s: float = 0.0,
) -> list[CommonScore]:
    """Judge named trajectories on their common frames, each with its own alignment.

    A frame is common when every trajectory has a pose within ``max_dt_s`` of it that is nearer to no other frame; the
    frames looked at are those of the shortest trajectory (a keyframe trajectory has few).

    Raises:
        EvaluationError: If they share fewer than two frames with each other and the ground truth.
    """
    clocked = []
    for name, estimate in estimates:
        truth, estimate = on_one_clock(truth, estimate)
        estimate = replace(estimate, stamps_s=estimate.stamps_s + offset_s)
        associate(truth.stamps_s, estimate.stamps_s, max_dt_s)
        clocked.append((name, estimate))
    frames = min((e.stamps_s for _, e in clocked), key=len)
    kept = np.ones(len(frames), dtype=bool)
    for _, estimate in clocked:
        found = nearest(estimate.stamps_s, frames)
        kept &= np.abs(estimate.stamps_s[found] - frames) <= max_dt_s
        # One pose serves one frame.
        kept &= nearest(frames, estimate.stamps_s[found]) == np.arange(len(frames))
    if kept.sum() < 2:
        names = ", ".join(name for name, _ in clocked)
        raise EvaluationError(f"{names}: {int(kept.sum())} frame(s) in common; are they of one sequence and clock?")
    out = []
    for name, estimate in clocked:
        few = estimate.take(nearest(estimate.stamps_s, frames[kept]))
        scores = (score_trajectory(truth, few, kind, max_dt_s) for kind in (AlignmentKind.SIM3, AlignmentKind.SE3))
        out.append(CommonScore(name, len(estimate), *scores))
    return out
