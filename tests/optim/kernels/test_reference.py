"""The solver against dense normal equations: cost, gradient and step of whole windows."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from seeded_window import WindowSize, seeded_window

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim import modules
from edgeslam_torch.optim.blocks import Anchors
from edgeslam_torch.optim.kernels.edges import PIXEL, RELATIVE_DEPTH
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, WindowProblem
from edgeslam_torch.optim.window import Window
from edgeslam_torch.types import FloatArray

UNBOUNDED = 1e18
"""Of a term without a robust kernel."""


class Dense(NamedTuple):
    """Everything at the start of a window; unknowns are free poses, anchors, edges and junctions in this order."""

    cost: float
    H: FloatArray
    """``(N, N)``."""
    g: FloatArray
    """``(N,)``."""
    poses: int
    """Number of the poses' unknowns."""


def dense(problem, config):
    """Cost and normal equations of a window, without pose priors, by the loss modules' rows."""
    free, T, K = ~np.asarray(problem.pose_fixed), problem.T_c_w, problem.K
    pose = np.where(free, 6 * (np.cumsum(free) - 1), -1)
    anchors = 6 * int(free.sum())
    edges = anchors + 3 * len(problem.p_w)
    junctions = edges + (0 if problem.edges is None else len(problem.edges.host))
    size = junctions + (0 if problem.junctions is None else 3 * len(problem.junctions.host))
    cost, H, g = 0.0, np.zeros((size, size)), np.zeros(size)

    def add(r, chi2_95, *parts):
        """Residuals ``(n, k)`` that share Huber's kernel, and derivatives ``(n, k, m)`` from columns ``(n,)`` on."""
        nonlocal cost
        norm, delta = np.linalg.norm(r, axis=1), chi2_95**0.5 if config.robust else UNBOUNDED
        cost += np.where(norm > delta, 2.0 * delta * norm - delta**2, norm**2).sum()
        J = np.zeros((*r.shape, size))
        for by, column in parts:
            for i in np.flatnonzero(column >= 0):
                J[i, :, column[i] : column[i] + by.shape[2]] += by[i]
        weight = delta / np.maximum(norm, delta)
        H[:] += np.einsum("n,nki,nkj->ij", weight, J, J)
        g[:] += np.einsum("n,nki,nk->i", weight, J, r)

    def add_pairs(kind, block, host, target, column, *arguments):
        """Each row of a pair under a kernel of its own; it depends on two poses by the motion between them."""
        motion = T[target] @ se3.inverse(T[host])
        r, J, _ = getattr(modules, kind)(motion, np.arange(len(host)), block, *arguments, K)
        by_host = -J[..., :6] @ np.stack([se3.adjoint(one) for one in motion])
        for k in range(r.shape[1]):
            row = slice(k, k + 1)
            own = (J[:, row, :6], pose[target]), (by_host[:, row], pose[host]), (J[:, row, 6:], column)
            add(r[:, row], 3.841, *own)

    seen, anchor = problem.obs_pose, problem.obs_anchor
    r, J, _ = modules.reprojection(T, problem.p_w, seen, anchor, problem.uv, problem.inv_sigma, K)
    add(r, 5.991, (J[..., :6], pose[seen]), (J[..., 6:], anchors + 3 * anchor))
    if (known := problem.depth_priors) is not None:
        told = known.inverse_depth, 1.0 / known.sigma
        r, J, _ = modules.inverse_depth(T, problem.p_w, known.pose, known.anchor, *told)
        add(r, 5.991, (J[..., :6], pose[known.pose]), (J[..., 6:], anchors + 3 * known.anchor))
    if (e := problem.edges) is not None:
        seen = e.uv, e.inverse_depth, e.pair_uv, e.pair_normal, e.pair_inv_sigma, e.pair_inverse_depth
        cycle, which = (PIXEL if e.cycle_px else RELATIVE_DEPTH, 1.0 / e.cycle_sigma), e.pair_edge
        add_pairs("edges", which, np.asarray(e.host)[which], e.pair_pose, edges + which, *seen, *cycle)
        weight, own = 1.0 / np.asarray(e.prior_sigma), edges + np.arange(len(e.host))
        add(((e.inverse_depth - e.prior) * weight)[:, None], UNBOUNDED, (weight[:, None, None], own))
    if (c := problem.junctions) is not None:
        seen = c.uv, c.inverse_depth, c.pair_uv, c.pair_arms, c.inv_sigma_px, c.inv_sigma_angle, c.cosines
        which = c.pair_junction
        add_pairs("junctions", which, np.asarray(c.host)[which], c.pair_pose, junctions + 3 * which, *seen)
        root = np.swapaxes(np.linalg.cholesky(c.prior_information), 1, 2)
        off = (root @ (c.inverse_depth - c.prior)[..., None])[..., 0]
        add(off, UNBOUNDED, (root, junctions + 3 * np.arange(len(c.host))))
    return Dense(cost, H, g, anchors)


def dense_step(system, mu):
    """The damped step ``(N,)``, unknowns that nothing observes left alone."""
    damped = system.H + mu * np.diag(np.diag(system.H))
    seen = np.diag(system.H) > 0
    out = np.zeros_like(system.g)
    out[seen] = -np.linalg.solve(damped[np.ix_(seen, seen)], system.g[seen])
    return out


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


SMALL = WindowSize(poses=5, fixed=2, anchors=14, observations=50, edges=10, pairs=24, junctions=4)
LONG = WindowSize(poses=15, fixed=1, anchors=24, observations=120, edges=0, pairs=0, junctions=0)
CASES = {
    "all terms": (SMALL, {}, {}),
    "anchors alone": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {}),
    "an anchor seen twice from one pose": (replace(SMALL, edges=0, pairs=0, junctions=0), {}, {"twice": True}),
    "many poses": (LONG, {}, {}),
    "least squares": (SMALL, {"robust": False}, {}),
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
    plain, refinement = dense(problem, config), Window(problem, config)
    system = refinement.linearise(refinement.start)
    assert system.cost == pytest.approx(plain.cost, rel=1e-9)
    poses, scale = plain.poses, np.sqrt(np.diag(plain.H)[: plain.poses])
    np.testing.assert_allclose(system.g / scale, plain.g[:poses] / scale, rtol=1e-7, atol=1e-7)
    both = np.outer(scale, scale)
    np.testing.assert_allclose(system.H / both, plain.H[:poses, :poses] / both, rtol=1e-7, atol=1e-7)
    step = refinement.propose(system, MU)
    expected = dense_step(plain, MU)
    moved = [(x - block.x).ravel() for block, x in zip(refinement.blocks, step.state.x, strict=True)]
    np.testing.assert_allclose(np.concatenate(moved), expected[poses:], rtol=1e-6, atol=1e-8)
    promised = expected @ (MU * np.diag(plain.H) * expected - plain.g)
    assert step.predicted == pytest.approx(promised, rel=1e-6)


def test_an_anchors_step_is_linear_in_the_inverse_distance_from_its_first_camera():
    """A step by half the distance doubles it, one towards the camera never passes it."""
    problem = window(3, replace(SMALL, edges=0, pairs=0, junctions=0))
    anchors = Window(problem, EXACT).anchors
    centre = se3.inverse(problem.T_c_w)[anchors.host, :3, 3]
    ray = anchors.x - centre
    for part, distance in ((0.5, 2.0), (-1.0, 0.5), (-9.0, 0.1)):
        moved = anchors.moved(problem.T_c_w, anchors.x, part * ray)
        np.testing.assert_allclose(moved - centre, distance * ray, rtol=1e-12)
