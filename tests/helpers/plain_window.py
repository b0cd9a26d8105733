"""The window's normal equations for tests: plain residuals, automatic derivatives, one dense matrix."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch
from edgeslam_torch.losses.robust import Kernel, rho


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


def step(system, mu):
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

    terms = [(anchors, config.delta)]
    if (known := problem.depth_priors) is not None:

        def depths(u):
            p_c = in_camera(poses(u)[known.pose], (_t(problem.p_w) + u.anchors)[known.anchor])
            return ((1.0 / p_c[:, 2] - _t(known.inverse_depth)) / _t(known.sigma))[:, None]

        terms.append((depths, config.delta))
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

    terms = [(alignment, config.edge_delta), (prior, None)]
    if e.cycle_sigma > 0:
        form = round_trip if e.cycle_px else relative_depth
        terms.append((form, config.edge_delta))
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

    return [(corner, config.edge_delta), (angles, config.edge_delta), (prior, None)]


def _t(x):
    return torch.as_tensor(np.asarray(x, dtype=np.float64))
