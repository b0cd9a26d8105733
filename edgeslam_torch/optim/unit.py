"""The unit of a refined window: nothing in it tells one, and what it is held by may have been wrong."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.problem import WindowProblem, WindowResult

MIN_EXTENT = 1e-6
"""Minimum distance between keyframes that defines a scale [map units]."""
_NEWEST, _LEAST_WAY = 10, 4
"""Keyframes that may still have drifted, a window of them, and older ones below which nothing else tells the unit."""


def with_same_depths(problem: WindowProblem, result: WindowResult, pose: int) -> WindowResult:
    """The result scaled about a fixed pose such that the median depth of the anchors that it sees is what it was.

    Between keyframes a false turn makes up several times the true distance, so that no distance may hold the unit of a
    map that is being straightened.
    """
    seen = problem.obs_anchor[problem.obs_pose == pose]
    if len(seen) == 0:
        return result
    T_c_w = problem.T_c_w[pose]
    before, after = (se3.transform(T_c_w, p[seen])[:, 2] for p in (problem.p_w, result.p_w))
    ahead = (before > 0) & (after > 0)
    if not ahead.any():
        return result
    return _scaled(result, pose, float(np.exp(np.median(np.log(before[ahead] / after[ahead])))))


def with_same_way(problem: WindowProblem, result: WindowResult, pose: int) -> WindowResult:
    """The result scaled about a fixed pose such that the way of all but the newest keyframes is as long as it was.

    The pose that is farthest away is mostly one of the newest, and a map drifts there: where its distance held the
    unit, telemetry that takes back a drift would shrink all the rest of the map instead. Unchanged where there are
    too few older ones, or they stand.

    Args:
        problem: Free poses in the order of time, with a fixed one before them.
        result: Of it.
        pose: Number of the fixed one.
    """
    order = [pose, *range(pose - _NEWEST)]
    if len(order) < _LEAST_WAY:
        return result
    before, after = (
        np.linalg.norm(np.diff(se3.inverse(T[order])[:, :3, 3], axis=0), axis=1) for T in (problem.T_c_w, result.T_c_w)
    )
    if before.sum() < MIN_EXTENT or after.sum() < MIN_EXTENT:
        return result
    return _scaled(result, pose, float((before @ after) / (after @ after)))


def _scaled(result: WindowResult, pose: int, ratio: float) -> WindowResult:
    """The result scaled about the camera of a pose."""
    T_w_c = se3.inverse(result.T_c_w)
    centre = T_w_c[pose, :3, 3].copy()
    T_w_c[:, :3, 3] = centre + ratio * (T_w_c[:, :3, 3] - centre)
    return replace(
        result,
        T_c_w=se3.inverse(T_w_c),
        p_w=centre + ratio * (result.p_w - centre),
        edge_inverse_depth=result.edge_inverse_depth / ratio,
    )
