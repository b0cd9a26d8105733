"""Sliding-window refinement of poses and anchors, paper eq. (28) and its thread 4."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.optim.adaptive import window_losses
from edgeslam_torch.optim.problem import LmConfig, StopReason, WindowProblem, WindowResult
from edgeslam_torch.optim.window import Window, refined


def refine_window(problem: WindowProblem, config: LmConfig | None = None) -> WindowResult:
    """Refine the free poses of a window with its anchors, edge depths and junctions.

    Args:
        problem: Poses, anchors, observations and priors.
        config: Solver settings.

    Returns:
        The refined window with the reason for stopping. Poses and points are finite if they were finite on entry.

    Raises:
        ValueError: If array lengths disagree or an index is out of range.
    """
    config = config or LmConfig()
    _check(problem)
    finite = all(
        bool(np.isfinite(x).all()) for x in (problem.T_c_w, problem.p_w, problem.uv, problem.inv_sigma, problem.K)
    )
    if not finite:
        return _unchanged(problem, StopReason.NOT_FINITE)
    if len(problem.obs_pose) == 0 and problem.edges is None and problem.junctions is None:
        return _unchanged(problem, StopReason.NO_OBSERVATIONS)
    result = Window(problem, config).refine()
    return replace(result, losses=window_losses(refined(problem, result))) if config.losses else result


def _check(problem: WindowProblem) -> None:
    W, A, M = len(problem.T_c_w), len(problem.p_w), len(problem.obs_pose)
    lengths = {len(problem.obs_anchor), len(problem.uv), len(problem.inv_sigma), M}
    if len(lengths) != 1:
        raise ValueError(f"obs_pose, obs_anchor, uv and inv_sigma must be equally long, got {sorted(lengths)}")
    if len(problem.pose_fixed) != W:
        raise ValueError(f"pose_fixed must have {W} entries, got {len(problem.pose_fixed)}")
    indices = [("obs_pose", problem.obs_pose, W), ("obs_anchor", problem.obs_anchor, A)]
    if problem.depth_priors is not None:
        known = problem.depth_priors
        lengths = {len(known.anchor), len(known.pose), len(known.inverse_depth), len(known.sigma)}
        if len(lengths) != 1:
            raise ValueError(f"the arrays of depth_priors must be equally long, got {sorted(lengths)}")
        indices += [("depth_priors.pose", known.pose, W), ("depth_priors.anchor", known.anchor, A)]
    for name, index, limit in indices:
        if len(index) and (np.min(index) < 0 or np.max(index) >= limit):
            raise ValueError(f"{name} must lie in [0, {limit}), got {np.min(index)}..{np.max(index)}")


def _unchanged(problem: WindowProblem, stop: StopReason) -> WindowResult:
    M = len(problem.obs_pose)
    return WindowResult(
        T_c_w=np.array(problem.T_c_w, dtype=np.float64),
        p_w=np.array(problem.p_w, dtype=np.float64),
        chi2=np.full(M, np.inf),
        cost_before=np.nan,
        cost_after=np.nan,
        iterations=0,
        stop=stop,
        rank_deficiency=-1,
    )
