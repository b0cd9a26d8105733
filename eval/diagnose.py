"""What is probably wrong with a trajectory whose error is large: each finding names the mistake and the remedy."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.align import AlignmentKind, umeyama
from edgeslam_torch.eval.associate import DEFAULT_MAX_DT_S, associate, match
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.formats import Trajectory
from edgeslam_torch.eval.trajectory import TrajectoryScore
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray

_POOR = 0.3
"""Share of the fixed-position error above which a trajectory is suspected: working systems stay below 0.1."""

_BETTER = 0.5
"""A mistake is named when undoing it brings the error below this share of what it was."""

_ROTATION_POOR_DEG = 8.0
"""Spread of the orientation error above which the quaternions are suspected; working systems stay below 3."""


def explain(
    truth: Trajectory, estimate: Trajectory, score: TrajectoryScore, max_dt_s: float = DEFAULT_MAX_DT_S
) -> list[str]:
    """Findings about ``estimate``, the most likely mistake first; empty when nothing is suspicious."""
    notes = [f"{estimate.source}: {note}" for note in (*estimate.notes, *score.association.notes)]
    notes += [f"{truth.source}: {note}" for note in truth.notes]
    notes += _scale_notes(score)
    if score.alignment.degenerate:
        notes.append("the motion is along a line: rotation about it is not determined, judge translation only")
    shape = _sim3_error(truth, estimate, score.association.offset_s, max_dt_s)
    if np.isfinite(shape) and shape > _POOR * score.fixed_position_m:
        notes += _shape_notes(truth, estimate, shape, score, max_dt_s)
    notes += _rotation_notes(truth, estimate, score)
    return notes


def _scale_notes(score: TrajectoryScore) -> list[str]:
    kind, scale = score.alignment.kind, score.scale
    if kind is not AlignmentKind.SIM3 and np.isfinite(scale) and abs(scale - 1.0) > 0.2:
        return [
            f"judged without scale ({kind.value}), but the estimate is {1 / scale:.3g} times the true size: only the "
            "Sim(3) figures mean anything for a monocular run without metric scale"
        ]
    if kind is AlignmentKind.SIM3 and scale <= 0.0:
        return ["the alignment found no positive scale: the two trajectories have nothing in common"]
    return []


def _shape_notes(
    truth: Trajectory, estimate: Trajectory, shape: float, score: TrajectoryScore, max_dt_s: float
) -> list[str]:
    offset = score.association.offset_s
    inverted = replace(estimate, T_w_c=se3.inverse(estimate.T_w_c))
    if _sim3_error(truth, inverted, offset, max_dt_s) < _BETTER * shape:
        return ["the poses look like world-to-camera; a trajectory must hold camera-to-world (their inverse)"]
    reversed_time = replace(estimate, stamps_s=estimate.stamps_s, T_w_c=estimate.T_w_c[::-1])
    if _sim3_error(truth, reversed_time, offset, max_dt_s) < _BETTER * shape:
        return ["the poses run backwards in time against their stamps"]
    shift, error = best_offset(truth, estimate, offset, max_dt_s)
    if error < _BETTER * shape and abs(shift - offset) > max_dt_s:
        return [f"the stamps are late or early by {shift:.2f} s: with --offset {shift:.2f} the ATE is {error:.3f} m"]
    share = shape / score.fixed_position_m
    if share > 0.7:
        return [
            f"ATE is {share:.0%} of what a fixed position scores ({score.fixed_position_m:.3f} m): the trajectory is "
            "probably of another sequence, or the run failed"
        ]
    return [
        f"ATE is {share:.0%} of what a fixed position scores ({score.fixed_position_m:.3f} m): the run drifted or broke"
    ]


def _rotation_notes(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> list[str]:
    """Quaternion mistakes do not show in positions; they show in the orientation."""
    now = _rotation_error(truth, estimate, score)
    if now < _ROTATION_POOR_DEG:
        constant = score.rotation_deg
        if constant.median > 20.0 and constant.std < 0.2 * constant.median:
            return [
                f"orientations differ by a constant {constant.median:.0f} deg: the two describe different bodies "
                "(camera and IMU or marker frame); only translation is comparable"
            ]
        return []
    if estimate.rows is not None:
        rows = estimate.rows
        swapped = Rotation.from_quat(rows[:, [4, 5, 6, 3]]).as_matrix()  # what stands in the file as qw qx qy qz
        if _rotation_error(truth, _with_rotation(estimate, swapped), score) < _BETTER * now:
            return ["the quaternions look like qw qx qy qz; TUM files need qx qy qz qw"]
    transposed = np.swapaxes(estimate.T_w_c[:, :3, :3], 1, 2)
    if _rotation_error(truth, _with_rotation(estimate, transposed), score) < _BETTER * now:
        return ["the orientations look inverted (world-to-camera rotation with camera-to-world positions)"]
    return []


def best_offset(
    truth: Trajectory, estimate: Trajectory, offset_s: float = 0.0, max_dt_s: float = DEFAULT_MAX_DT_S
) -> tuple[float, float]:
    """Time offset [s] within ±10 s with the least Sim(3) ATE, and that ATE [m]."""
    best = (offset_s, _sim3_error(truth, estimate, offset_s, max_dt_s))
    reach = min(10.0, 0.5 * float(estimate.stamps_s[-1] - estimate.stamps_s[0]))
    for step in (0.1, 0.01):
        around = best[0] if step < 0.1 else offset_s
        span = reach if step == 0.1 else 0.1
        for shift in np.arange(around - span, around + span + step / 2, step):
            error = _sim3_error(truth, estimate, float(shift), max_dt_s, least_share=0.4)
            if error < best[1]:
                best = (float(shift), error)
    return best


def _with_rotation(trajectory: Trajectory, R: FloatArray) -> Trajectory:
    T = trajectory.T_w_c.copy()
    T[:, :3, :3] = R
    return replace(trajectory, T_w_c=T)


def _sim3_error(
    truth: Trajectory, estimate: Trajectory, offset_s: float, max_dt_s: float, least_share: float = 0.0
) -> float:
    """Sim(3) ATE [m], infinite when too few poses match."""
    factor = 1.0
    if offset_s == 0.0:
        factor = associate(truth.stamps_s, estimate.stamps_s, max_dt_s).factor
    i, j = match(truth.stamps_s, estimate.stamps_s * factor + offset_s, max_dt_s)
    if len(i) < max(3, least_share * min(len(truth), len(estimate))):
        return float("inf")
    p, q = estimate.positions[j], truth.positions[i]
    try:
        error = umeyama(p, q).points(p) - q
    except EvaluationError:
        return float("inf")
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _rotation_error(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> float:
    """Median angle [deg] of the aligned orientation errors to their mean: a constant body offset does not count.

    The angle *between* two poses cannot tell: the scalar product of quaternions is the same in any order.
    """
    pairs = score.association
    R_true, R = truth.T_w_c[pairs.truth, :3, :3], estimate.T_w_c[pairs.estimate, :3, :3]
    error = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ score.alignment.R @ R)
    return float(np.median(np.degrees((error.mean().inv() * error).magnitude())))
