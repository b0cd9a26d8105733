"""Several trajectories on the frames that all of them have: a fair comparison when one starts late or gets lost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, associate, nearest
from edgeslam_torch.eval.inputs.clocks import on_one_clock
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore, score_trajectory


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

    A frame is common when every trajectory has a pose within ``max_dt_s`` of it; the frames looked at are those of the
    shortest trajectory (a keyframe trajectory has few).

    Raises:
        EvaluationError: If they share fewer than two frames with each other and the ground truth.
    """
    clocked = []
    for name, estimate in estimates:
        truth, estimate = on_one_clock(truth, estimate)
        associate(truth.stamps_s, estimate.stamps_s, max_dt_s, offset_s)
        clocked.append((name, replace(estimate, stamps_s=estimate.stamps_s + offset_s)))
    frames = min((e.stamps_s for _, e in clocked), key=len)
    kept = np.ones(len(frames), dtype=bool)
    for _, estimate in clocked:
        found = nearest(estimate.stamps_s, frames)
        kept &= np.abs(estimate.stamps_s[found] - frames) <= max_dt_s
        # One pose serves one frame.
        kept &= np.concatenate([[True], np.diff(found) > 0])
    if kept.sum() < 2:
        names = ", ".join(name for name, _ in clocked)
        raise EvaluationError(f"{names}: {int(kept.sum())} frame(s) in common; are they of one sequence and clock?")
    out = []
    for name, estimate in clocked:
        few = estimate.take(nearest(estimate.stamps_s, frames[kept]))
        scores = (score_trajectory(truth, few, kind, max_dt_s) for kind in (AlignmentKind.SIM3, AlignmentKind.SE3))
        out.append(CommonScore(name, len(estimate), *scores))
    return out
