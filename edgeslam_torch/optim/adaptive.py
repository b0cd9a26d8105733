"""Adaptive weights of a window, and its losses as the paper defines them, paper eq. (28).

The paper balances its terms by "adaptive weighting based on uncertainty" and gives no formula. Here every term is
whitened by a robust standard deviation of its own residuals, so that the weights of eq. (28) are pure numbers.
"""

from dataclasses import replace

import numpy as np

from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.optim.blocks import Blocks, Normal
from edgeslam_torch.optim.problem import LmConfig, WindowProblem
from edgeslam_torch.optim.window import Window
from edgeslam_torch.types import FloatArray

SMALLEST_SIGMA = 1e-9
"""Minimum standard deviation of a term; smaller residuals are rounding errors."""


SCALES = {
    "reproj": (1.0, 0.5, 3.0),
    "edge": (1.0, 0.5, 3.0),
    "cycle": (0.05, 0.01, 0.3),
    "corner": (1.0, 0.5, 3.0),
    "angle": (0.05, 0.01, 0.3),
}
"""Prior standard deviation of each term, and bounds, so that no window lets a term dominate or disables it."""
PRIOR_WEIGHT = 0.8
"""Weight of the prior standard deviation (in its logarithm) beside that of one map."""
MIN_COUNT = 30
"""Minimum number of residuals to measure a standard deviation."""


def term_sigmas(residuals: dict[str, FloatArray]) -> dict[str, float]:
    """Standard deviation of every term from its valid residuals; the prior one without enough of them."""
    sigmas: dict[str, float] = {}
    for name, (prior, low, high) in SCALES.items():
        found = residuals.get(name, np.zeros(0))
        measured = robust_sigma(found) if found.size >= MIN_COUNT else prior
        sigmas[name] = prior**PRIOR_WEIGHT * min(max(measured, low), high) ** (1.0 - PRIOR_WEIGHT)
    return sigmas


def term_residuals(problem: WindowProblem) -> dict[str, FloatArray]:
    """Residuals of every term of a window at its current state, by name of its scale.

    Returns:
        ``reproj`` [px of the finest octave], ``edge`` [px], ``cycle`` (relative depth) or ``cycle px`` (the paper's
        form), ``corner`` [px] and ``angle`` (sine or cosine), ``(N, k)`` each; terms that are off and elements behind a
        camera are omitted.
    """
    window = Window(_unit(problem), LmConfig())
    normals: dict[Blocks, Normal] = dict(zip(window.blocks, window.linearise(window.start).blocks, strict=True))
    out = {}
    anchors = normals[window.anchors]
    if anchors.front.any():
        out["reproj"] = anchors.r[anchors.front]
    if window.edges is not None and problem.edges is not None:
        r, front = normals[window.edges].r, normals[window.edges].front
        used = front & (problem.edges.pair_inv_sigma > 0)
        if used.any():
            out["edge"] = r[used, :1]
        used = front & (problem.edges.pair_inverse_depth > 0)
        if used.any() and problem.edges.cycle_sigma > 0:
            out["cycle px" if problem.edges.cycle_px else "cycle"] = r[used, 1:]
    if window.junctions is not None and problem.junctions is not None:
        r = normals[window.junctions].r[normals[window.junctions].front]
        if problem.junctions.inv_sigma_px > 0:
            out["corner"] = r[:, :2]
        if problem.junctions.inv_sigma_angle > 0:
            out["angle"] = r[:, 2:]
    return out


def window_losses(problem: WindowProblem) -> dict[str, float]:
    """Mean squared residual of every active term, and their weighted sum, paper eqs. (15)-(28).

    Args:
        problem: A window; omitted terms stay omitted.

    Returns:
        ``reprojection_px2``, ``alignment_px2``, ``cycle`` (relative depth squared) or ``cycle_px2``, ``angle``
        (cosine squared), and ``total``: the sum with every term divided by its robust variance, so that normally
        distributed residuals contribute 1 per term. Empty for a window without terms.
    """
    junctions = problem.junctions if problem.junctions is None else replace(problem.junctions, cosines=True)
    found = term_residuals(replace(problem, inv_sigma=np.ones(len(problem.uv)), junctions=junctions))
    losses, total = {}, 0.0
    for name, key in _LOSSES.items():
        if key in found:
            losses[name] = (
                float((found[key] ** 2).sum(-1).mean()) if found[key].ndim > 1 else float((found[key] ** 2).mean())
            )
            sigma = robust_sigma(found[key])
            total += losses[name] / sigma**2 if sigma > SMALLEST_SIGMA else 0.0
    return losses | {"total": total} if losses else {}


_LOSSES = {
    "reprojection_px2": "reproj",
    "alignment_px2": "edge",
    "cycle": "cycle",
    "cycle_px2": "cycle px",
    "angle": "angle",
}


def with_scales(problem: WindowProblem, sigma: dict[str, float], inflation: float = 1.0) -> WindowProblem:
    """The window with its terms' standard deviations replaced; terms that are off stay off.

    Args:
        problem: A window.
        sigma: From `term_sigmas`.
        inflation: Factor on the sigmas of edge terms: errors of neighbouring pixels on an edge are correlated, so
            ``inflation**2`` of them count as one.
    """
    problem = replace(problem, inv_sigma=problem.inv_sigma / sigma["reproj"])
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        name = "edge" if edges.cycle_px else "cycle"
        edges = replace(
            edges,
            pair_inv_sigma=np.where(edges.pair_inv_sigma > 0, 1.0 / (inflation * sigma["edge"]), 0.0),
            cycle_sigma=inflation * sigma[name] if edges.cycle_sigma > 0 else 0.0,
        )
    if junctions is not None:
        junctions = replace(
            junctions,
            inv_sigma_px=1.0 / sigma["corner"] if junctions.inv_sigma_px > 0 else 0.0,
            inv_sigma_angle=1.0 / sigma["angle"] if junctions.inv_sigma_angle > 0 else 0.0,
        )
    return replace(problem, edges=edges, junctions=junctions)


def _unit(problem: WindowProblem) -> WindowProblem:
    """The window with edges and junctions not whitened."""
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        edges = replace(
            edges, pair_inv_sigma=np.ones(len(edges.pair_edge)), cycle_sigma=1.0 if edges.cycle_sigma > 0 else 0.0
        )
    if junctions is not None:
        junctions = replace(junctions, inv_sigma_px=1.0, inv_sigma_angle=1.0)
    return replace(problem, edges=edges, junctions=junctions)
