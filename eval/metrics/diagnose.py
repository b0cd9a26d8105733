"""Diagnosis of large trajectory errors: each finding names the mistake and its remedy."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, match
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, umeyama
from edgeslam_torch.eval.metrics.clock_offset import best_offset
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray

_POOR = 0.3
"""Share of the fixed-position error above which a trajectory is suspected: working systems stay below 0.1."""

_BETTER = 0.5
"""A mistake is named when undoing it brings the error below this share of what it was."""

_ROTATION_POOR_DEG = 8.0
"""Orientation error above which the quaternions are suspected; working systems stay below 3."""

_FEW = 10
"""Minimum number of matched poses for a diagnosis."""

_MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
_MIRRORED = "the positions are mirrored: two axes swapped, one negated, or a left-handed world"

_UNEXPLAINED = "the orientations do not follow the truth's, and no usual mistake explains it: judge translation only"

_LENGTH_UNITS = {0.01: "centimetres", 0.001: "millimetres"}


def explain(
    truth: Trajectory, estimate: Trajectory, score: TrajectoryScore, max_dt_s: float = DEFAULT_MAX_DT_S
) -> list[str]:
    """Findings about ``estimate``, the most likely mistake first; empty when nothing is suspicious."""
    notes = [f"{estimate.source}: {note}" for note in (*estimate.notes, *score.association.notes)]
    notes += [f"{truth.source}: {note}" for note in truth.notes]
    if score.matched < _FEW:
        few = f"only {score.matched} poses have ground truth: an alignment fits almost anything to so few"
        return [*notes, few]
    notes += _match_notes(truth, estimate, score)
    notes += _scale_notes(score)
    if score.alignment.degenerate:
        notes.append("the motion is along a line: rotation about it is not determined, judge translation only")
    clock = score.association
    estimate = replace(estimate, stamps_s=estimate.stamps_s * clock.factor + clock.offset_s)
    shape = _sim3_error(truth, estimate, max_dt_s)
    if np.isfinite(shape) and shape > _POOR * score.fixed_position_m:
        return notes + _shape_notes(truth, estimate, shape, score, max_dt_s)
    found = _rotation_notes(truth, estimate, score)
    if found == [_UNEXPLAINED]:  # in motion that is nearly flat a mirror hardly shows in the positions
        mirrored = _sim3_error(truth, replace(estimate, T_w_c=_MIRROR @ estimate.T_w_c), max_dt_s)
        found = [_MIRRORED] if mirrored < _BETTER * shape else found
    return notes + found


def _match_notes(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> list[str]:
    """Fewer pairs than there could be."""
    stamps = estimate.stamps_s * score.association.factor + score.association.offset_s
    both = (max(truth.stamps_s[0], stamps[0]), min(truth.stamps_s[-1], stamps[-1]))
    possible = min(int(((t >= both[0]) & (t <= both[1])).sum()) for t in (truth.stamps_s, stamps))
    if score.matched < 0.5 * possible:
        return [f"only {score.matched} of {possible} poses found a partner in time: a larger --max-dt, or --offset?"]
    return []


def _scale_notes(score: TrajectoryScore) -> list[str]:
    kind, scale = score.alignment.kind, score.scale
    for metres, name in _LENGTH_UNITS.items():
        if np.isfinite(scale) and 0.8 * metres < scale < 1.25 * metres:
            return [f"the estimate is {1 / scale:.0f} times the true size: its lengths look like {name}, not metres"]
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
    """The mistake whose undoing explains the positions best; else how bad they are."""
    T = estimate.T_w_c
    undone = {
        "the poses look like world-to-camera; a trajectory must hold camera-to-world (their inverse)": se3.inverse(T),
        "the poses run backwards in time against their stamps": T[::-1],
        _MIRRORED: _MIRROR @ T,
    }
    suspects = [(_sim3_error(truth, replace(estimate, T_w_c=T), max_dt_s), text) for text, T in undone.items()]
    late = best_offset(truth, estimate)
    if abs(late.shift_s) > max_dt_s:
        remedy = f"with --offset {score.association.offset_s + late.shift_s:.2f} the ATE is {late.ate_m:.3f} m"
        suspects.append((late.ate_m, f"the stamps are late or early by {late.shift_s:.2f} s: {remedy}"))
    error, text = min(suspects)
    if error < min(_BETTER * shape, _POOR * score.fixed_position_m):
        return [text]
    share = shape / score.fixed_position_m
    verdict = "the trajectory is probably of another sequence, or the run failed"
    return [
        f"ATE is {share:.0%} of what a fixed position scores ({score.fixed_position_m:.3f} m): "
        + (verdict if share > 0.7 else "the run drifted or broke")
    ]


def _rotation_notes(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> list[str]:
    """Quaternion mistakes do not show in positions; they show in the orientation.

    Two measures: the angle to the truth, which a wrong order or inverse makes large, and the spread of that error
    about its mean, which a constant turn between two bodies (camera and marker frame) leaves small.
    """
    R = estimate.T_w_c[:, :3, :3]
    angle, spread = _rotation_error(truth, R, score)
    if angle < _ROTATION_POOR_DEG:
        return []
    if _spread_deg(R) < 0.1 and _spread_deg(truth.T_w_c[:, :3, :3]) > 2.0:
        return ["every orientation in the file is the same: whoever wrote it left the orientation out"]
    mended = {
        "the orientations look inverted (world-to-camera rotation with camera-to-world positions)": np.swapaxes(R, 1, 2)
    }
    if estimate.rows is not None:  # the file's columns read as qw qx qy qz
        swapped = Rotation.from_quat(estimate.rows[:, [4, 5, 6, 3]]).as_matrix()
        mended["the quaternions look like qw qx qy qz; TUM files need qx qy qz qw"] = swapped
    errors = {text: _rotation_error(truth, R_mended, score) for text, R_mended in mended.items()}
    text = min(errors, key=lambda key: errors[key][0])
    if errors[text][0] < min(_BETTER * angle, _ROTATION_POOR_DEG):
        return [text]
    text = min(errors, key=lambda key: errors[key][1])
    if spread > _ROTATION_POOR_DEG and errors[text][1] < _BETTER * spread:
        return [text]
    if angle > 20.0 and spread < 0.2 * angle:
        return [
            f"orientations differ by a constant {angle:.0f} deg: the two describe different bodies "
            "(camera and IMU or marker frame); only translation is comparable"
        ]
    return [_UNEXPLAINED] if spread > _ROTATION_POOR_DEG else []


def _sim3_error(truth: Trajectory, estimate: Trajectory, max_dt_s: float) -> float:
    """Sim(3) ATE [m] of an estimate on the truth's clock, infinite when too few poses match."""
    i, j = match(truth.stamps_s, estimate.stamps_s, max_dt_s)
    if len(i) < 3:
        return float("inf")
    p, q = estimate.positions[j], truth.positions[i]
    try:
        error = umeyama(p, q).points(p) - q
    except EvaluationError:
        return float("inf")
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _rotation_error(truth: Trajectory, R: FloatArray, score: TrajectoryScore) -> tuple[float, float]:
    """Median angle [deg] of orientations ``(M, 3, 3)``, aligned, to the truth, and median of its spread about its mean.

    The angle *between* two poses cannot tell: the scalar product of quaternions is the same in any order.
    """
    pairs = score.association
    R_true = truth.T_w_c[pairs.truth, :3, :3]
    error = Rotation.from_matrix(np.swapaxes(R_true, 1, 2) @ score.alignment.R @ R[pairs.estimate])
    spread = (error.mean().inv() * error).magnitude()
    return float(np.degrees(np.median(error.magnitude()))), float(np.degrees(np.median(spread)))


def _spread_deg(R: FloatArray) -> float:
    """Largest angle [deg] between the first of rotations ``(M, 3, 3)`` and another."""
    return float(np.degrees(Rotation.from_matrix(R[0].T @ R).magnitude().max()))
