"""Diagnosis of large trajectory errors: each finding names the mistake, whose it is, and its remedy.

Both files are tested for every mistake; ground truth may be converted wrongly, too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, match, on_one_clock, possible_pairs
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, best_offset, misfit
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore, without_orientation
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import (
    angles,
    matrices_from_quaternions,
    mean_rotation,
    quaternions_from_matrices,
)
from edgeslam_torch.types import FloatArray

_POOR = 0.3
"""Share of the fixed-position error above which a trajectory is suspected: working systems stay below 0.1."""

_BETTER = 0.5
"""A mistake is named when undoing it brings the error below this share of what it was."""

_ROTATION_POOR_DEG = 8.0
"""Orientation error above which the quaternions are suspected; working systems stay below 3."""

_FEW = 10
"""Minimum number of matched poses for a diagnosis."""

_ESTIMATE, _TRUTH, _BOTH = "the estimate's", "the ground truth's", "both files'"
_EITHER = "one file's (undecidable which)"

_MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
_BACKWARDS = "the poses run backwards in time against their stamps"
_MIRRORED = "the positions are mirrored: in one file two axes are swapped, one negated, or its world is left-handed"
_INVERSE = "poses look like world-to-camera; a trajectory must hold camera-to-world (their inverse)"
_INVERTED = "orientations look inverted (world-to-camera rotation with camera-to-world positions)"
_W_FIRST = "quaternions look like qw qx qy qz; TUM files need qx qy qz qw, other orders a header that names the columns"

_UNEXPLAINED = (
    "the orientations do not follow the truth's, and no common mistake explains it: evaluate translation only"
)

_LENGTH_UNITS = {0.01: "centimetres", 0.001: "millimetres"}


@dataclass(frozen=True, slots=True)
class _Suspect:
    """A mistake, and the error that is left when it is undone."""

    whose: str
    mistake: str
    error: float

    @property
    def text(self) -> str:
        return f"{self.whose} {self.mistake}".strip()


def explain(
    truth: Trajectory, estimate: Trajectory, score: TrajectoryScore, max_dt_s: float = DEFAULT_MAX_DT_S
) -> list[str]:
    """Findings about the two files, the most likely mistake first; empty when nothing is suspicious."""
    truth, estimate = on_one_clock(truth, estimate)
    notes = [f"{file.source}: {note}" for file in (estimate, truth) for note in file.notes]
    if score.matched < _FEW:
        few = f"only {score.matched} poses have ground truth: an alignment fits almost anything to so few"
        return [*notes, few]
    estimate = replace(estimate, stamps_s=estimate.stamps_s + score.offset_s)
    possible = possible_pairs(truth.stamps_s, estimate.stamps_s)
    if score.matched < 0.5 * possible:
        few = f"only {score.matched} of {possible} poses found a partner in time"
        notes.append(f"{few}: a larger --max-dt, or --offset?")
    notes += _scale_notes(score)
    if score.alignment.degenerate:
        notes.append("the motion is along a line: rotation about it is not determined, judge translation only")
    bare = without_orientation(truth, estimate)
    if bare is not None:
        whose = _TRUTH if bare is truth else _ESTIMATE
        lacks = "orientations are all the same" if bare.oriented else "file has positions alone"
        notes.append(f"{whose} {lacks}: figures that need orientations are left out")
    shape = _misfit(truth, estimate, max_dt_s)
    if np.isfinite(shape) and shape > _POOR:
        return notes + _shape_notes(truth, estimate, shape, score, max_dt_s)
    if bare is not None:
        return notes
    found = _rotation_notes(truth, estimate, score)
    if found == [_UNEXPLAINED]:  # in motion that is nearly flat a mirror hardly shows in the positions
        mirrored = _misfit(truth, replace(estimate, T_w_c=_MIRROR @ estimate.T_w_c), max_dt_s)
        found = [_MIRRORED] if mirrored < _BETTER * shape else found
    return notes + found


def _scale_notes(score: TrajectoryScore) -> list[str]:
    kind, scale = score.alignment.kind, score.scale
    for metres, name in _LENGTH_UNITS.items():
        if 0.8 * metres < scale < 1.25 * metres:
            return [f"the estimate is {1 / scale:.0f} times the true size: its lengths look like {name}, not metres"]
        if 0.8 / metres < scale < 1.25 / metres:
            return [
                f"the ground truth is {scale:.0f} times the size of the estimate: its lengths look like {name}, and so "
                "are the errors (unless the estimate has no metric scale)"
            ]
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
    undone = [
        (whose, _INVERSE, t, e)
        for whose, t, e in _combinations(truth, estimate, _inverse)
        if truth.oriented or whose == _ESTIMATE
        if estimate.oriented or whose == _TRUTH
    ]
    undone += [
        ("", _BACKWARDS, truth, replace(estimate, T_w_c=estimate.T_w_c[::-1])),
        ("", _MIRRORED, truth, replace(estimate, T_w_c=_MIRROR @ estimate.T_w_c)),
    ]
    suspects = [_Suspect(whose, mistake, _misfit(t, e, max_dt_s)) for whose, mistake, t, e in undone]
    late = best_offset(truth, estimate)
    if abs(late.shift_s) > max_dt_s:
        remedy = f"with --offset {score.offset_s + late.shift_s:.2f} the ATE is {late.ate_m:.3f} m"
        suspects.append(_Suspect("", f"the stamps are late or early by {late.shift_s:.2f} s: {remedy}", late.share))
    named = _likeliest(suspects, min(_BETTER * shape, _POOR))
    if named is not None:
        return [named]
    verdict = "the trajectory is probably of another sequence, or the run failed"
    return [
        f"ATE is {shape:.0%} of what a fixed position scores ({score.fixed_position_m:.3f} m): "
        + (verdict if shape > 0.7 else "the run drifted or broke")
    ]


def _rotation_notes(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> list[str]:
    """Quaternion mistakes do not show in positions; they show in the orientation.

    Two measures: the angle to the truth, which a wrong order or inverse makes large, and the spread of that error
    about its mean, which a constant turn between two bodies (camera and marker frame) leaves small.
    """
    angle, spread = _rotation_error(truth, estimate, score)
    if angle < _ROTATION_POOR_DEG:
        return []
    errors = [
        (whose, mistake, *_rotation_error(t, e, score))
        for mistake, undo in ((_INVERTED, _transposed), (_W_FIRST, _read_w_first))
        for whose, t, e in _combinations(truth, estimate, undo)
        if whose != _BOTH  # which explains mirrored positions as well
    ]
    named = _likeliest(
        [_Suspect(whose, mistake, left) for whose, mistake, left, _ in errors], min(_BETTER * angle, _ROTATION_POOR_DEG)
    )
    if named is None and spread > _ROTATION_POOR_DEG:
        named = _likeliest([_Suspect(whose, mistake, left) for whose, mistake, _, left in errors], _BETTER * spread)
    if named is not None:
        return [named]
    if angle > 20.0 and spread < 0.2 * angle:
        return [
            f"orientations differ by a constant {angle:.0f} deg: the two describe different bodies "
            "(camera and IMU or marker frame); only translation is comparable"
        ]
    return [_UNEXPLAINED] if spread > _ROTATION_POOR_DEG else []


def _combinations(
    truth: Trajectory, estimate: Trajectory, undo: Callable[[Trajectory], Trajectory]
) -> list[tuple[str, Trajectory, Trajectory]]:
    """A mistake undone in one file, in the other, in both."""
    return [
        (_ESTIMATE, truth, undo(estimate)),
        (_TRUTH, undo(truth), estimate),
        (_BOTH, undo(truth), undo(estimate)),
    ]


def _likeliest(suspects: Sequence[_Suspect], limit: float) -> str | None:
    """The mistake that explains most, if its error is below ``limit``, and the file that has it, if decidable."""
    best = min(suspects, key=lambda suspect: suspect.error)
    if not best.error < limit:
        return None
    similar = [s for s in suspects if s.mistake == best.mistake and s.error < 2.0 * best.error + 0.1 * limit]
    return (best if len(similar) == 1 else replace(best, whose=_EITHER)).text


def _inverse(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, T_w_c=se3.inverse(trajectory.T_w_c))


def _transposed(trajectory: Trajectory) -> Trajectory:
    return _turned(trajectory, np.swapaxes(trajectory.T_w_c[:, :3, :3], 1, 2))


def _read_w_first(trajectory: Trajectory) -> Trajectory:
    """What was read as qx qy qz qw taken for qw qx qy qz."""
    read = quaternions_from_matrices(trajectory.T_w_c[:, :3, :3])
    return _turned(trajectory, matrices_from_quaternions(read[:, [1, 2, 3, 0]]))


def _turned(trajectory: Trajectory, R: FloatArray) -> Trajectory:
    T = trajectory.T_w_c.copy()
    T[:, :3, :3] = R
    return replace(trajectory, T_w_c=T)


def _misfit(truth: Trajectory, estimate: Trajectory, max_dt_s: float) -> float:
    """`misfit` of an estimate on the truth's clock; infinite when too few poses match."""
    i, j = match(truth.stamps_s, estimate.stamps_s, max_dt_s)
    return misfit(estimate.positions[j], truth.positions[i]) if len(i) >= 3 else float("inf")


def _rotation_error(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore) -> tuple[float, float]:
    """Median angle [deg] of aligned orientations to the truth's, and median of its spread about its mean.

    The angle *between* two poses does not help: the scalar product of quaternions is the same in any order.
    """
    R_true, R = (file.T_w_c[index, :3, :3] for file, index in zip((truth, estimate), score.pairs, strict=True))
    error = np.swapaxes(R_true, 1, 2) @ score.alignment.R @ R
    spread = angles(mean_rotation(error).T @ error)
    return float(np.degrees(np.median(angles(error)))), float(np.degrees(np.median(spread)))
