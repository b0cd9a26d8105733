"""Adaptive weights of a window: every term whitened by the robust scale of its own residuals, paper eq. (28)."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.edge_alignment import (
    alignment_row,
    pair_geometry,
    partner_line,
    relative_depth_row,
    round_trip_row,
)
from edgeslam_torch.losses.lshape import junction_residuals
from edgeslam_torch.losses.reprojection import camera_points, reprojection_residuals
from edgeslam_torch.losses.weighting import AdaptiveScales
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms, WindowProblem
from edgeslam_torch.types import FloatArray, IntArray


def term_residuals(problem: WindowProblem) -> dict[str, Tensor]:
    """Residuals of every term of a window at its current state, by name of its scale.

    Returns:
        ``reproj`` [px of the finest octave], ``edge`` [px], ``cycle`` (relative depth, or px in the paper's form),
        ``corner`` [px] and ``angle`` (sine or cosine), each ``(N,)``; terms that are off and elements behind a camera
        are omitted.
    """
    out = {}
    K = torch.tensor(problem.K, dtype=torch.float64)
    if len(problem.obs_pose):
        T, p_w = _values(problem.T_c_w), _values(problem.p_w)
        _, p_c = camera_points(T, p_w, _index(problem.obs_pose), _index(problem.obs_anchor))
        r = reprojection_residuals(p_c, _values(problem.uv).mT, K) * _values(problem.inv_sigma)
        out["reproj"] = r[:, p_c[2] > 0].flatten()
    if problem.edges is not None and len(problem.edges.pair_edge):
        out |= _edge_residuals(problem.edges, problem.T_c_w, K)
    if problem.junctions is not None and len(problem.junctions.pair_junction):
        out |= _junction_residuals(problem.junctions, problem.T_c_w, K)
    return out


def with_scales(problem: WindowProblem, scales: AdaptiveScales, alike: float = 1.0) -> WindowProblem:
    """The window with its terms' standard deviations replaced by scales; terms that are off stay off.

    Args:
        problem: A window.
        scales: As `AdaptiveScales.updated` makes them of `term_residuals`.
        alike: Factor on the sigmas of edge terms: neighbours on one edge have correlated errors, so ``alike**2`` of
            them count as one.
    """
    sigma = {name: term.sigma for name, term in scales.terms.items()}
    problem = replace(problem, inv_sigma=problem.inv_sigma / sigma["reproj"])
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        name = "cycle" if edges.cycle is CycleForm.RELATIVE_DEPTH else "edge"
        edges = replace(
            edges,
            pair_inv_sigma=np.where(edges.pair_inv_sigma > 0, 1.0 / (alike * sigma["edge"]), 0.0),
            cycle_sigma=alike * sigma[name] if edges.cycle_sigma > 0 else 0.0,
        )
    if junctions is not None:
        junctions = replace(
            junctions,
            inv_sigma_px=1.0 / sigma["corner"] if junctions.inv_sigma_px > 0 else 0.0,
            inv_sigma_angle=1.0 / sigma["angle"] if junctions.inv_sigma_angle > 0 else 0.0,
        )
    return replace(problem, edges=edges, junctions=junctions)


def _edge_residuals(terms: EdgeTerms, T_c_w: FloatArray, K: Tensor) -> dict[str, Tensor]:
    edge = _index(terms.pair_edge)
    Rt = _motions(T_c_w, np.asarray(terms.host)[terms.pair_edge], terms.pair_pose)
    ray = ((_values(terms.uv)[edge] - K[2:]) / K[:2]).mT
    g = pair_geometry(Rt, ray, _values(terms.inverse_depth)[edge])
    out = {}
    used = g.front & (_values(terms.pair_inv_sigma) > 0)
    if bool(used.any()):
        px = torch.ones((), dtype=torch.float64)
        out["edge"] = alignment_row(g, partner_line(_values(terms.pair_uv).mT, _values(terms.pair_normal).mT, px, K))[
            used
        ]
    held = _values(terms.pair_inverse_depth)
    used = g.front & (held > 0)
    if terms.cycle_sigma > 0 and bool(used.any()):
        held = torch.where(held > 0, held, 1.0)
        if terms.cycle is CycleForm.RELATIVE_DEPTH:
            out["cycle"] = relative_depth_row(g, held)[used]
        else:
            out["cycle px"] = round_trip_row(g, Rt, ray, held, K)[:, used].flatten()
    return out


def _junction_residuals(terms: JunctionTerms, T_c_w: FloatArray, K: Tensor) -> dict[str, Tensor]:
    corner = _index(terms.pair_junction)
    Rt = _motions(T_c_w, np.asarray(terms.host)[terms.pair_junction], terms.pair_pose)
    rays = ((_values(terms.uv)[corner] - K[2:]) / K[:2]).permute(2, 1, 0)
    depth = _values(terms.inverse_depth)[corner].mT
    arms = _values(terms.pair_arms).permute(2, 1, 0)
    r, front = junction_residuals(Rt, rays, depth, _values(terms.pair_uv).mT, arms, K, terms.cosines)
    out = {}
    if terms.inv_sigma_px > 0:
        out["corner"] = r[:2, front].flatten()
    if terms.inv_sigma_angle > 0:
        out["angle"] = r[2:, front].flatten()
    return out


def _motions(T_c_w: FloatArray, host: IntArray, target: IntArray) -> Tensor:
    """``(3, 4, P)`` from host to target."""
    T = _values(T_c_w)
    return (T[_index(target)] @ lie.inverse(T)[_index(host)])[:, :3].permute(1, 2, 0)


def _values(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.float64))


def _index(x: IntArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.int64))
