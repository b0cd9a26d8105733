"""The solver against dense normal equations: cost, gradient and step of whole windows."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from seeded_window import WindowSize, seeded_window
from torch import Tensor

from edgeslam_torch.geometry import se3, se3_torch
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim.blocks import Anchors
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, WindowProblem
from edgeslam_torch.optim.window import State, System, Window


class Unknowns(NamedTuple):
    """Steps away from a window's start."""

    poses: Tensor
    """``(F, 6)`` left tangents of the free poses."""
    anchors: Tensor
    """``(A, 3)``."""
    edges: Tensor
    """``(E,)`` inverse depths."""
    junctions: Tensor
    """``(C, 3)`` inverse depths."""


class Dense(NamedTuple):
    """Everything at the start of a window."""

    cost: Tensor
    H: Tensor
    """``(N, N)``: poses, anchors, edges, junctions, each as `Unknowns` has it."""
    g: Tensor
    """``(N,)``."""
    split: tuple[int, int, int, int]
    """Numbers of unknowns."""


Term = tuple[Callable[[Unknowns], Tensor], float | None]
"""Whitened residuals ``(n, k)`` whose square over ``k`` goes through a kernel of this width; None for none."""


def dense(problem, config):
    """Cost and normal equations of a window, without pose priors; all points must lie in front."""
    zero = _zero(problem)
    size = sum(x.numel() for x in zero)
    cost, H, g = torch.zeros((), dtype=torch.float64), torch.zeros(size, size).double(), torch.zeros(size).double()
    for residual, delta in _terms(problem, config):
        r = residual(zero)
        by = torch.func.jacfwd(residual, 0)(zero)
        J = torch.cat([d.reshape(*r.shape, -1) for d in by], 2)
        value, weight = (r.square().sum(1), torch.ones(len(r)).double())
        if delta is not None and math.isfinite(delta):
            value, weight = rho(value, Kernel.HUBER, delta)
        cost = cost + value.sum()
        H += torch.einsum("n,nki,nkj->ij", weight, J, J)
        g += torch.einsum("n,nki,nk->i", weight, J, r)
    a, b, c, d = (x.numel() for x in zero)
    return Dense(cost, H, g, (a, b, c, d))


def dense_step(system, mu):
    """The damped step ``(N,)``, unknowns that nothing observes left alone."""
    damped = system.H + mu * torch.diag(system.H.diagonal())
    seen = system.H.diagonal() > 0
    out = torch.zeros_like(system.g)
    out[seen] = -torch.linalg.solve(damped[seen][:, seen], system.g[seen])
    return out


def _zero(problem):
    edges = 0 if problem.edges is None else len(problem.edges.host)
    junctions = 0 if problem.junctions is None else len(problem.junctions.host)
    free = int((~np.asarray(problem.pose_fixed)).sum())
    shapes = (free, 6), (len(problem.p_w), 3), (edges,), (junctions, 3)
    return Unknowns(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))


def _terms(problem, config):
    fx, fy, cx, cy = problem.K
    focal, centre = _t([fx, fy]), _t([cx, cy])
    start, free = _t(problem.T_c_w), torch.as_tensor(~np.asarray(problem.pose_fixed))

    def poses(u):
        return start.index_put((free.nonzero()[:, 0],), se3_torch.exp(u.poses) @ start[free])

    def in_camera(T, p):
        return (T[:, :3, :3] @ p[..., None])[..., 0] + T[:, :3, 3]

    def pixel(p_c):
        return p_c[..., :2] / p_c[..., 2:] * focal + centre

    def anchors(u):
        p_c = in_camera(poses(u)[problem.obs_pose], (_t(problem.p_w) + u.anchors)[problem.obs_anchor])
        return (pixel(p_c) - _t(problem.uv)) * _t(problem.inv_sigma)[:, None]

    terms = [(anchors, _delta(config, 5.991))]
    if (known := problem.depth_priors) is not None:

        def depths(u):
            p_c = in_camera(poses(u)[known.pose], (_t(problem.p_w) + u.anchors)[known.anchor])
            return ((1.0 / p_c[:, 2] - _t(known.inverse_depth)) / _t(known.sigma))[:, None]

        terms.append((depths, _delta(config, 5.991)))
    if problem.edges is not None:
        terms += _edge_terms(problem, config, poses, in_camera, pixel)
    if problem.junctions is not None:
        terms += _junction_terms(problem, config, poses, in_camera, pixel)
    return terms


def _relative(T, host, target):
    return T[target] @ se3_torch.inverse(T[host])


def _edge_terms(problem, config, poses, in_camera, pixel):
    e = problem.edges
    fx, fy, cx, cy = problem.K
    ray = torch.cat(((_t(e.uv) - _t([cx, cy])) / _t([fx, fy]), torch.ones(len(e.host), 1).double()), 1)
    which, host = e.pair_edge, np.asarray(e.host)[e.pair_edge]

    def depth(u):
        return _t(e.inverse_depth) + u.edges

    def in_target(u):
        return in_camera(_relative(poses(u), host, e.pair_pose), (ray / depth(u)[:, None])[which])

    def alignment(u):
        across = ((pixel(in_target(u)) - _t(e.pair_uv)) * _t(e.pair_normal)).sum(1)
        return (across * _t(e.pair_inv_sigma))[:, None]

    held = np.asarray(e.pair_inverse_depth) > 0

    def relative_depth(u):
        z, z_held = in_target(u)[held, 2], 1.0 / _t(e.pair_inverse_depth)[held]
        return ((z - z_held) / (z + z_held) / e.cycle_sigma)[:, None]

    def round_trip(u):
        p = in_target(u)[held]
        at_held_depth = p / p[:, 2:] / _t(e.pair_inverse_depth)[held, None]
        back = in_camera(_relative(poses(u), e.pair_pose[held], host[held]), at_held_depth)
        return ((pixel(back) - _t(e.uv)[which[held]]) / e.cycle_sigma).reshape(-1, 1)

    def prior(u):
        known = np.isfinite(e.prior_sigma)
        return ((depth(u) - _t(e.prior))[known] / _t(e.prior_sigma)[known])[:, None]

    terms = [(alignment, _delta(config, 3.841)), (prior, None)]
    if e.cycle_sigma > 0:
        form = round_trip if e.cycle_px else relative_depth
        terms.append((form, _delta(config, 3.841)))
    return terms


def _junction_terms(problem, config, poses, in_camera, pixel):
    c = problem.junctions
    fx, fy, cx, cy = problem.K
    rays = (_t(c.uv) - _t([cx, cy])) / _t([fx, fy])
    rays = torch.cat((rays, torch.ones(*rays.shape[:2], 1).double()), 2)
    which, host = c.pair_junction, np.asarray(c.host)[c.pair_junction]

    def depth(u):
        return _t(c.inverse_depth) + u.junctions

    def ends(u):
        """Pixels ``(Q, 3, 2)`` of corner and arm ends in the target."""
        T = _relative(poses(u), host, c.pair_pose)
        p = (rays / depth(u)[..., None])[which]
        return torch.stack([pixel(in_camera(T, p[:, k])) for k in range(3)], 1)

    def arms(u):
        uv = ends(u)
        along = uv[:, 1:] - uv[:, :1]
        return along / along.norm(dim=2, keepdim=True)

    def corner(u):
        return ((ends(u)[:, 0] - _t(c.pair_uv)) * c.inv_sigma_px).reshape(-1, 1)

    def angles(u):
        seen, measured = arms(u), _t(c.pair_arms)
        if c.cosines:
            cosine = (seen[:, 0] * seen[:, 1]).sum(1) - (measured[:, 0] * measured[:, 1]).sum(1)
            return (cosine * c.inv_sigma_angle)[:, None]
        sine = measured[..., 0] * seen[..., 1] - measured[..., 1] * seen[..., 0]
        return (sine * c.inv_sigma_angle).reshape(-1, 1)

    root = torch.linalg.cholesky(_t(c.prior_information)).mT

    def prior(u):
        return (root @ (depth(u) - _t(c.prior))[..., None])[..., 0]

    return [(corner, _delta(config, 3.841)), (angles, _delta(config, 3.841)), (prior, None)]


def _delta(config, chi2_95):
    """Threshold of Huber's kernel: 95 % of normally distributed residuals."""
    return chi2_95**0.5 if config.robust else math.inf


def _t(x):
    return torch.as_tensor(np.asarray(x, dtype=np.float64))


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
    plain = dense(problem, config)
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
    expected = dense_step(plain, MU)
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
