"""The solver against dense normal equations: cost, gradient and step of whole windows."""

import math
from dataclasses import replace

import numpy as np
import plain_window
import pytest
import torch
from seeded_window import WindowSize, seeded_window

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.blocks import Anchors
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, WindowProblem
from edgeslam_torch.optim.window import State, System, Window

EXACT = LmConfig(behind_px=1e6)
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


def linearised(problem: WindowProblem, config: LmConfig) -> tuple[Window, System]:
    solver = Window(problem, config)
    return solver, solver.linearise(solver.start)


def moved(solver: Window, state: State) -> torch.Tensor:
    """Updates of anchors, edges and junctions, in the plain window's order."""
    parts = [torch.as_tensor(x - block.x).flatten() for block, x in zip(solver.blocks, state.x, strict=True)]
    return torch.cat(parts)


SMALL = WindowSize(poses=5, fixed=2, anchors=14, observations=50, edges=10, pairs=24, junctions=4)
LONG = WindowSize(poses=15, fixed=1, anchors=24, observations=120, edges=0, pairs=0, junctions=0)
CASES = {
    "all terms": (SMALL, {}, {}),
    "anchors alone": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {}),
    "an anchor seen twice from one pose": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {"twice": True}),
    "many poses": (LONG, {}, {}),
    "least squares": (SMALL, {"delta": math.inf, "edge_delta": math.inf}, {}),
    "cycle in pixels": (SMALL, {}, {"cycle_px": True}),
    "cosines": (SMALL, {}, {"cosines": True}),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("solver", ["compiled", "modules"])
def test_window_is_the_dense_one(case, solver, monkeypatch):
    monkeypatch.setattr(Anchors, "moved", lambda self, T_c_w, x, step: x + step)
    size, settings, changes = CASES[case]
    config, problem = replace(EXACT, solver=solver, **settings), window(3, size)
    if "cycle_px" in changes:
        problem = replace(problem, edges=replace(problem.edges, cycle_px=True, cycle_sigma=0.7))
    if "cosines" in changes:
        problem = replace(problem, junctions=replace(problem.junctions, cosines=True))
    if "twice" in changes:
        again = {name: np.concatenate([getattr(problem, name)] * 2) for name in ("obs_pose", "obs_anchor", "inv_sigma")}
        problem = replace(problem, uv=np.concatenate([problem.uv, problem.uv + 1.0]), **again)
    plain = plain_window.dense(problem, config)
    refinement, system = linearised(problem, config)
    assert system.cost == pytest.approx(float(plain.cost), rel=1e-9)
    poses = plain.split[0]
    scale = plain.H.diagonal()[:poses].sqrt()
    torch.testing.assert_close(torch.as_tensor(system.g) / scale, plain.g[:poses] / scale, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(
        torch.as_tensor(system.H) / scale / scale[:, None],
        plain.H[:poses, :poses] / scale / scale[:, None],
        rtol=1e-7,
        atol=1e-7,
    )
    step = refinement.propose(system, MU)
    assert step is not None
    expected = plain_window.step(plain, MU)
    torch.testing.assert_close(moved(refinement, step.state), expected[poses:], rtol=1e-6, atol=1e-8)
    promised = expected @ (MU * plain.H.diagonal() * expected - plain.g)
    assert step.predicted == pytest.approx(float(promised), rel=1e-6)


def test_an_anchors_step_is_linear_in_the_inverse_distance_from_its_first_camera():
    """A step by half the distance doubles it, one towards the camera never passes it."""
    problem = window(3, replace(SMALL, edges=0, pairs=0, junctions=0))
    anchors = Window(problem, EXACT).anchors
    centre = se3.inverse(problem.T_c_w)[anchors.host, :3, 3]
    ray = anchors.x - centre
    for part, distance in ((0.5, 2.0), (-1.0, 0.5), (-9.0, 0.1)):
        moved = anchors.moved(problem.T_c_w, anchors.x, part * ray)
        np.testing.assert_allclose(moved - centre, distance * ray, rtol=1e-12)
