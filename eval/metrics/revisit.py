"""Error at the return: distance in the estimate between two distant passes of the same place."""

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import associate
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import umeyama

MIN_WAY_M = 10.0
"""Way from a place back to it from which on it counts as a return."""
SAME_PLACE_M = 0.5


def return_error_percent(truth: Trajectory, estimate: Trajectory) -> float:
    """Median over all frames that return to a place, in % of the way since it was left; NaN where none returns.

    The difference of a frame's error and that of the frame nearest to it before the way, after Sim(3) alignment.

    Raises:
        EvaluationError: If the stamps do not match, or the estimate never moves.
    """
    pairs = associate(truth.stamps_s, estimate.stamps_s)
    p, q = truth.positions[pairs.truth], estimate.positions[pairs.estimate]
    error = umeyama(q, p).points(q) - p
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    found = []
    for i in range(len(p)):
        before = np.searchsorted(way, way[i] - MIN_WAY_M, side="right")
        if before == 0:
            continue
        apart = np.linalg.norm(p[:before] - p[i], axis=1)
        nearest = int(apart.argmin())
        if apart[nearest] <= SAME_PLACE_M:
            found.append(np.linalg.norm(error[i] - error[nearest]) / (way[i] - way[nearest]))
    return 100.0 * float(np.median(found)) if found else float("nan")


def returns(truth: Trajectory, run: Trajectory, online: Trajectory | None) -> dict[str, float]:
    """Figures of a run's refined and live trajectory; empty where they cannot be compared."""
    try:
        refined = return_error_percent(truth, run)
        live = float("nan") if online is None else return_error_percent(truth, online)
    except EvaluationError:
        return {}
    return {"return_percent": refined, "return_online_percent": live}
