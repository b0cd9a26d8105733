"""Scale of a refined window, which images do not determine: chosen after refinement."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.problem import WindowProblem, WindowResult

MIN_EXTENT = 1e-6
"""Minimum distance between keyframes that defines a scale [map units]."""
_NEWEST, _LEAST_WAY = 10, 4
"""Number of newest keyframes, which may have drifted (a window), and minimum number of older ones to fix the scale."""


def with_same_depths(problem: WindowProblem, result: WindowResult, pose: int) -> WindowResult:
    """The result scaled about a fixed pose such that the median depth of its anchors is unchanged.

    A rotation mistaken for translation changes distances between keyframes several times over, so that none of them can
    fix the scale while it is corrected.
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
    """The result scaled about a fixed pose such that the path length of all but the newest keyframes is unchanged.

    The farthest pose is mostly one of the newest, where a map drifts: if its distance fixed the scale, a correction of
    the drift by telemetry would shrink the rest of the map instead. Unchanged if there are too few older keyframes or
    they are static.

    Args:
        problem: Free poses in temporal order, after a fixed one.
        result: Its refined state.
        pose: Index of the fixed pose.
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
