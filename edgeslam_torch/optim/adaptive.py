"""Adaptive weights of a window, and its losses as the paper defines them, paper eq. (28).

The paper balances its terms by "adaptive weighting based on uncertainty" and gives no formula. Here every term is
whitened by a robust standard deviation of its own residuals, so that the weights of eq. (28) are pure numbers.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.optim.blocks import Blocks, Normal
from edgeslam_torch.optim.problem import LmConfig, WindowProblem
from edgeslam_torch.optim.window import Window
from edgeslam_torch.types import FloatArray

SMALLEST_SIGMA = 1e-9
"""Minimum standard deviation of a term; smaller residuals are rounding errors."""


@dataclass(frozen=True, slots=True)
class TermScale:
    """Running robust standard deviation of one term."""

    sigma: float
    """Current estimate, in the residual's unit."""
    low: float
    """Lower bound, so that no term dominates after a window with unusually small residuals."""
    high: float
    """Upper bound, so that a bad window does not disable a term."""
    smoothing: float = 0.8
    """Weight of the old value (in its logarithm) at each update."""
    min_count: int = 30
    """Minimum number of residuals for an update."""

    def __post_init__(self) -> None:
        if not 0 < self.low <= self.sigma <= self.high:
            raise ValueError(f"need 0 < low <= sigma <= high, got {self.low}, {self.sigma}, {self.high}")
        if not 0 <= self.smoothing < 1:
            raise ValueError(f"smoothing must lie in [0, 1), got {self.smoothing}")

    def updated(self, residual: FloatArray) -> "TermScale":
        """The scale updated with one window's valid residuals."""
        if residual.size < self.min_count:
            return self
        new = robust_sigma(residual)
        if not new >= 0:
            return self
        new = min(max(new, self.low), self.high)
        smooth = self.sigma**self.smoothing * new ** (1.0 - self.smoothing)
        return replace(self, sigma=min(max(smooth, self.low), self.high))


@dataclass(frozen=True, slots=True)
class AdaptiveScales:
    """Scales of all terms of a window."""

    terms: dict[str, TermScale] = field(
        default_factory=lambda: {
            "reproj": TermScale(1.0, 0.5, 3.0),
            "edge": TermScale(1.0, 0.5, 3.0),
            "cycle": TermScale(0.05, 0.01, 0.3),
            "corner": TermScale(1.0, 0.5, 3.0),
            "angle": TermScale(0.05, 0.01, 0.3),
        }
    )

    def updated(self, residuals: dict[str, FloatArray]) -> "AdaptiveScales":
        """Scales updated with one window; terms without residuals are unchanged."""
        new = {k: s.updated(residuals[k]) if k in residuals else s for k, s in self.terms.items()}
        return replace(self, terms=new)


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


def with_scales(problem: WindowProblem, scales: AdaptiveScales, alike: float = 1.0) -> WindowProblem:
    """The window with its terms' standard deviations replaced by scales; terms that are off stay off.

    Args:
        problem: A window.
        scales: From `AdaptiveScales.updated` with `term_residuals`.
        alike: Factor on the sigmas of edge terms: errors of neighbouring pixels on an edge are correlated, so
            ``alike**2`` of them count as one.
    """
    sigma = {name: term.sigma for name, term in scales.terms.items()}
    problem = replace(problem, inv_sigma=problem.inv_sigma / sigma["reproj"])
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        name = "edge" if edges.cycle_px else "cycle"
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
