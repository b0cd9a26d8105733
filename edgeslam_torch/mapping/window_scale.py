"""Scale of a refined window, which images do not determine: chosen after refinement."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.problem import WindowProblem, WindowResult
from edgeslam_torch.types import FloatArray, IntArray

MIN_EXTENT = 1e-6
"""Minimum distance between keyframes that defines a scale [map units]."""


def with_same_depths(problem: WindowProblem, result: WindowResult, pose: int, older: int = 0) -> WindowResult:
    """The result scaled about a fixed pose such that the median depth of what older keyframes see is unchanged.

    Distances between keyframes cannot fix the scale: a rotation mistaken for translation changes them several times
    over, the farthest keyframe is mostly one of the newest, where a map drifts, and the first ones of a flight stand
    still.

    Args:
        problem: Free poses in temporal order, after the fixed one.
        result: Its refined state.
        pose: Index of the fixed pose.
        older: Number of free poses, the oldest, whose depths count as well.
    """
    used = (problem.obs_pose == pose) | (problem.obs_pose < older)
    seen, by = problem.obs_anchor[used], problem.obs_pose[used]
    before, after = (_depth(s.T_c_w, s.p_w, by, seen) for s in (problem, result))
    ahead = (before > 0) & (after > 0)
    if not ahead.any():
        return result
    return _scaled(result, pose, float(np.exp(np.median(np.log(before[ahead] / after[ahead])))))


def _depth(T_c_w: FloatArray, p_w: FloatArray, pose: IntArray, anchor: IntArray) -> FloatArray:
    """Depths ``(M,)`` of observed anchors."""
    return np.einsum("mi,mi->m", T_c_w[pose, 2, :3], p_w[anchor]) + T_c_w[pose, 2, 3]


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
