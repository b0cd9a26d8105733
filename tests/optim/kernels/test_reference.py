"""The solver's kernels against the plain window of docs/theory/window.md: cost, gradient and step of whole windows."""

from dataclasses import replace

import numpy as np
import plain_window
import pytest
import torch

from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.optim.benchmark import WindowSize, seeded_window
from edgeslam_torch.optim.kernels import point_blocks
from edgeslam_torch.optim.local_ba import _State, _System, _Window
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, WindowProblem

EXACT = LmConfig(float32_blocks=False, behind_px=1e6)
MU = 1e-3


def window(seed: int, size: WindowSize, **changes: object) -> WindowProblem:
    """A seeded window with outliers, so that weights differ, and with depth priors."""
    problem = seeded_window(seed, size).problem
    rng = np.random.default_rng(seed)
    uv = problem.uv + np.where(rng.random((len(problem.uv), 1)) < 0.2, rng.normal(0, 8, problem.uv.shape), 0)
    n = 12
    pose, anchor = problem.obs_pose[:n], problem.obs_anchor[:n]
    T, p = problem.T_c_w[pose], problem.p_w[anchor]
    z = (T[:, 2, :3] * p).sum(1) + T[:, 2, 3]
    priors = DepthPriors(anchor, pose, rng.uniform(0.8, 1.2, n) / z, rng.uniform(0.05, 0.1, n))
    return replace(problem, uv=uv, depth_priors=priors, **changes)


def linearised(problem: WindowProblem, config: LmConfig) -> tuple[_Window, _System]:
    solver = _Window(problem, config)
    return solver, solver.linearise(solver.start)


def moved(solver: _Window, problem: WindowProblem, state: _State) -> torch.Tensor:
    """Updates of anchors, edges and junctions, in the plain window's order."""
    parts = [torch.as_tensor(solver.points.in_callers_order(state.p) - problem.p_w).flatten()]
    for block, x in solver._blocks(state):
        start = problem.edges.inverse_depth if block.size == 1 else problem.junctions.inverse_depth
        parts.append(torch.as_tensor(block.tiles.of_blocks(x).T - np.asarray(start).reshape(-1, block.size)).flatten())
    return torch.cat(parts)


SMALL = WindowSize(poses=5, fixed=2, anchors=14, observations=50, edges=10, pairs=24, junctions=4)
LONG = WindowSize(poses=15, fixed=1, anchors=24, observations=120, edges=0, pairs=0, junctions=0)
CASES = {
    "all terms": (SMALL, {}, {}),
    "anchors alone": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {}),
    "an anchor seen twice from one pose": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {"twice": True}),
    "chunks of anchors over many poses": (LONG, {}, {}),
    "least squares": (SMALL, {"kernel": Kernel.L2}, {}),
    "Cauchy": (SMALL, {"kernel": Kernel.CAUCHY}, {}),
    "cycle in pixels": (SMALL, {}, {"cycle": CycleForm.PIXEL}),
    "cosines": (SMALL, {}, {"cosines": True}),
}


@pytest.mark.parametrize("case", CASES)
def test_window_is_that_of_the_page(case, monkeypatch):
    monkeypatch.setattr(point_blocks, "_ANCHORS_PER_CHUNK", 9)  # several chunks of a few anchors
    size, settings, changes = CASES[case]
    config, problem = replace(EXACT, **settings), window(3, size)
    if "cycle" in changes:
        problem = replace(problem, edges=replace(problem.edges, cycle=changes["cycle"], cycle_sigma=0.7))
    if "cosines" in changes:
        problem = replace(problem, junctions=replace(problem.junctions, cosines=True))
    if "twice" in changes:
        again = {name: np.concatenate([getattr(problem, name)] * 2) for name in ("obs_pose", "obs_anchor", "inv_sigma")}
        problem = replace(problem, uv=np.concatenate([problem.uv, problem.uv + 1.0]), **again)
    plain = plain_window.dense(problem, config)
    solver, system = linearised(problem, config)
    assert len(solver.points.chunks) == (3 if size is LONG else 1)
    assert system.cost == pytest.approx(float(plain.cost), rel=1e-9)
    poses = plain.split[0]
    scale = plain.H.diagonal()[:poses].sqrt()
    torch.testing.assert_close(system.g / scale, plain.g[:poses] / scale, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(
        system.H / scale / scale[:, None], plain.H[:poses, :poses] / scale / scale[:, None], rtol=1e-7, atol=1e-7
    )
    step = solver.propose(system, MU)
    assert step is not None
    expected = plain_window.step(plain, MU)
    torch.testing.assert_close(moved(solver, problem, step.state), expected[poses:], rtol=1e-6, atol=1e-8)
    promised = expected @ (MU * plain.H.diagonal() * expected - plain.g)
    assert step.predicted == pytest.approx(float(promised), rel=1e-6)


def test_single_precision_blocks_step_as_far():
    problem = window(3, SMALL)
    exact, exact_system = linearised(problem, EXACT)
    fast, fast_system = linearised(problem, replace(EXACT, float32_blocks=True))
    a, b = exact.propose(exact_system, MU), fast.propose(fast_system, MU)
    assert a is not None and b is not None
    torch.testing.assert_close(b.state.T_c_w, a.state.T_c_w, rtol=0, atol=1e-5)


def test_a_step_is_that_of_its_own_elimination_whatever_was_reduced_since():
    """Two reductions of one system do not share memory."""
    problem = window(4, replace(SMALL, edges=0, pairs=0, junctions=0))
    solver, system = linearised(problem, EXACT)
    S, b = system.H.clone(), system.g.clone()
    first = solver.points.reduce(system.points, MU, S, b)
    delta = torch.full((len(b),), 1e-3, dtype=torch.float64)
    before = solver.points.step(system.points, first, delta)
    solver.points.reduce(system.points, 10.0, S, b)
    torch.testing.assert_close(solver.points.step(system.points, first, delta), before, rtol=0, atol=0)
