"""The losses of a window as the paper defines them, evaluated by the loss modules.

The solver minimises the same residuals with kernels of its own, which are fast and hold analytic derivatives. This is
the plain form: it measures refined maps (``summary.json``), and tests compare the kernels with it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3
from edgeslam_torch.losses.base import Reduction, Residuals, reduce
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss
from edgeslam_torch.losses.edge_alignment import EdgeAlignmentLoss
from edgeslam_torch.losses.lshape import AngleLoss
from edgeslam_torch.losses.reprojection import ReprojectionLoss
from edgeslam_torch.losses.total import TotalLoss
from edgeslam_torch.losses.weighting import robust_sigma
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms, WindowProblem, WindowResult
from edgeslam_torch.types import FloatArray, IntArray

SMALLEST_SIGMA = 1e-9
"""Below this a term's residuals are rounding errors, and its weight would be meaningless."""


def window_losses(problem: WindowProblem) -> dict[str, float]:
    """Mean squared residual of every active term, and their weighted sum, paper eqs. (15)-(28).

    Args:
        problem: A window; terms that it leaves out are left out.

    Returns:
        ``reprojection_px2``, ``alignment_px2``, ``cycle`` (relative depth squared) or ``cycle_px2``, ``angle``
        (cosine squared), and ``total``: the sum with every term divided by its robust variance, so that 1 is what
        normally distributed residuals contribute. Empty for a window without terms.
    """
    terms = window_residuals(problem)
    losses = {name: reduce(residuals, Reduction.MEAN) for name, residuals in terms.items()}
    if not losses:
        return {}
    total = TotalLoss({name: _inverse_variance(residuals) for name, residuals in terms.items()})
    return {name: float(loss) for name, loss in losses.items()} | {"total": float(total(losses))}


def window_residuals(problem: WindowProblem) -> dict[str, Residuals]:
    """Signed residuals of every active term, by the loss modules; names as `window_losses`."""
    K = torch.tensor([[problem.K[0], 0.0, problem.K[2]], [0.0, problem.K[1], problem.K[3]], [0.0, 0.0, 1.0]]).double()
    parts: dict[str, list[Residuals]] = {"reprojection_px2": list(_reprojection(problem, K))}
    if problem.edges is not None:
        parts |= _edges(problem.edges, problem.T_c_w, K)
    if problem.junctions is not None and problem.junctions.inv_sigma_angle > 0:
        parts["angle"] = list(_angles(problem.junctions, problem.T_c_w, K))
    return {name: _joined(part) for name, part in parts.items() if part}


def refined(problem: WindowProblem, result: WindowResult) -> WindowProblem:
    """The window at the state that the solver found."""
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        edges = replace(edges, inverse_depth=result.edge_inverse_depth)
    if junctions is not None:
        junctions = replace(junctions, inverse_depth=result.junction_inverse_depth)
    return replace(problem, T_c_w=result.T_c_w, p_w=result.p_w, edges=edges, junctions=junctions)


def _reprojection(problem: WindowProblem, K: Tensor) -> Iterator[Residuals]:
    loss = ReprojectionLoss()
    for pose, seen in _groups(problem.obs_pose):
        p_w, uv = _values(problem.p_w[problem.obs_anchor[seen]]), _values(problem.uv[seen])
        each = loss.residuals(_values(problem.T_c_w[[pose]]), p_w, uv[None], K)
        yield Residuals(each.value[0], each.valid[0])


def _edges(terms: EdgeTerms, T_c_w: FloatArray, K: Tensor) -> dict[str, list[Residuals]]:
    alignment = EdgeAlignmentLoss()
    # No occlusion mask: pairs were selected by depth, and the solver counts all of them.
    cycle = CycleLoss(terms.cycle, max_relative=float("inf"))
    out: dict[str, list[Residuals]] = {}
    names = {"alignment_px2": bool((terms.pair_inv_sigma > 0).any())}
    cycle_name = "cycle" if terms.cycle is CycleForm.RELATIVE_DEPTH else "cycle_px2"
    names[cycle_name] = terms.cycle_sigma > 0
    host = np.asarray(terms.host)[terms.pair_edge]
    for pair, (i, j) in _motions(host, np.asarray(terms.pair_pose)):
        edge = terms.pair_edge[pair]
        T_j_i, uv = _values(T_c_w[j] @ se3.inverse(T_c_w[i])), _values(terms.uv[edge])
        depth_i = _depth(terms.inverse_depth[edge])
        if names["alignment_px2"]:
            normal = terms.pair_normal[pair] * (terms.pair_inv_sigma[pair] > 0)[:, None]
            seen = _values(terms.pair_uv[pair]), _values(normal)
            out.setdefault("alignment_px2", []).append(alignment.residuals(T_j_i, uv, depth_i, *seen, K))
        if names[cycle_name]:
            depth_j = _depth(terms.pair_inverse_depth[pair])
            out.setdefault(cycle_name, []).append(cycle.residuals(T_j_i, uv, depth_i, depth_j, K))
    return out


def _angles(terms: JunctionTerms, T_c_w: FloatArray, K: Tensor) -> Iterator[Residuals]:
    loss = AngleLoss()
    host = np.asarray(terms.host)[terms.pair_junction]
    for pair, (i, j) in _motions(host, np.asarray(terms.pair_pose)):
        corner, arms = terms.pair_junction[pair], terms.pair_arms[pair]
        T_j_i, cos_j = _values(T_c_w[j] @ se3.inverse(T_c_w[i])), _values((arms[:, 0] * arms[:, 1]).sum(1))
        yield loss.residuals(T_j_i, _values(terms.uv[corner]), _depth(terms.inverse_depth[corner]), cos_j, K)


def _motions(host: IntArray, target: IntArray) -> Iterator[tuple[IntArray, tuple[int, int]]]:
    """Pairs that share host and target pose, and those two."""
    key = host * (int(target.max(initial=0)) + 1) + target
    for _, pair in _groups(key):
        yield pair, (int(host[pair[0]]), int(target[pair[0]]))


def _groups(key: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Indices of the elements that share a key, for every key."""
    order = np.argsort(key, kind="stable")
    values, first = np.unique(np.asarray(key)[order], return_index=True)
    for value, members in zip(values, np.split(order, first[1:]), strict=False):  # no key: one empty group
        yield int(value), members


def _joined(parts: list[Residuals]) -> Residuals:
    return Residuals(torch.cat([p.value for p in parts]), torch.cat([p.valid for p in parts]))


def _inverse_variance(residuals: Residuals) -> float:
    sigma = float(robust_sigma(residuals.value[residuals.valid])) if bool(residuals.valid.any()) else 0.0
    return sigma**-2 if sigma > SMALLEST_SIGMA else 0.0


def _depth(inverse_depth: FloatArray) -> Tensor:
    """z-depth; 0, which the losses leave out, where the inverse depth is not positive."""
    return _values(np.where(inverse_depth > 0, 1.0 / np.where(inverse_depth > 0, inverse_depth, 1.0), 0.0))


def _values(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.float64))
