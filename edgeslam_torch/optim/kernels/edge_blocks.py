"""Edge pixels in the window: alignment across the edge and the depth cycle, one inverse depth each.

Paper eqs. (20) to (23), and the distance across the nearest edge of another view; the rows and their derivatives are
`losses.edge_alignment`'s.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.edge_alignment import (
    alignment_jacobians,
    alignment_row,
    depth_slopes,
    pair_geometry,
    partner_line,
    relative_depth_jacobians,
    relative_depth_row,
    round_trip_jacobians,
    round_trip_row,
)
from edgeslam_torch.optim.kernels import schur
from edgeslam_torch.optim.kernels.compiled import kernel
from edgeslam_torch.optim.kernels.pair_blocks import (
    Known,
    Layout,
    Linearised,
    RelativeBlocks,
    Robust,
    Weighed,
    as_system,
    relative_motions,
    robust_sum,
)
from edgeslam_torch.optim.problem import EdgeTerms, LmConfig
from edgeslam_torch.types import FloatArray


class EdgeTiles(NamedTuple):
    """Edge pixels and what the views that see them measured, in tiles."""

    ray: Tensor
    """``(2, B, 1, L)`` normalised coordinates in the host."""
    line: Tensor
    """``(3, B, T, L)`` the partner's edge in the target, whitened, see `partner_line`."""
    held: Tensor
    """``(B, T, L)`` inverse depth that the target holds for the partner; 1 where it holds none."""
    cycle_weight: Tensor
    """``(B, T, L)`` inverse standard deviation of the cycle's residual; 0 without one."""
    K: Tensor
    """fx, fy, cx, cy."""
    form: CycleForm | None
    """None without a cycle."""
    robust: Robust


class EdgePrior(NamedTuple):
    """Prior on the inverse depths."""

    mean: Tensor
    """``(1, B, L)``."""
    weight: Tensor
    """``(1, B, L)`` inverse variances; 0 where nothing is known."""

    def at(self, x: Tensor) -> Known:
        """At inverse depths ``(1, B, L)``."""
        e = x - self.mean
        g = self.weight * e
        return Known(self.weight, g, (g * e).sum())


def edge_weights(Rt: Tensor, x: Tensor, pairs: EdgeTiles) -> Weighed:
    """Alignment and cycle rows at relative motions ``(3, 4, B, T, 1)`` and inverse depths ``(1, B, L)``."""
    x = x[0, :, None]
    g = pair_geometry(Rt, pairs.ray, x)
    slope = depth_slopes(g, Rt[:, 3])
    r = alignment_row(g, pairs.line)
    value, root = robust_sum(r, g.front, pairs.robust)
    by_pose, by_depth = alignment_jacobians(g, slope, pairs.line * root)
    J, Jd = [(*by_pose, r * root)], [(by_depth,)]
    if pairs.form is CycleForm.RELATIVE_DEPTH:
        r = relative_depth_row(g, pairs.held) * pairs.cycle_weight
        cost, root = robust_sum(r, g.front, pairs.robust)
        value = value + cost
        by_pose, by_depth = relative_depth_jacobians(g, slope, pairs.held, pairs.cycle_weight * root)
        J.append((*by_pose, r * root))
        Jd.append((by_depth,))
    elif pairs.form is CycleForm.PIXEL:
        r, by_poses, by_depths = round_trip_jacobians(g, slope, Rt, pairs.ray, pairs.held, pairs.K)
        r = r * pairs.cycle_weight
        cost, root = robust_sum(r, g.front, pairs.robust)
        value = value + cost
        for k in range(2):
            J.append((*(by_poses[k] * (pairs.cycle_weight * root[k])).unbind(0), r[k] * root[k]))
            Jd.append((by_depths[k] * (pairs.cycle_weight * root[k]),))
    return Weighed(*schur.pair_products(J, Jd), value)


def edge_system(T_c_w: Tensor, x: Tensor, layout: Layout, prior: EdgePrior, pairs: EdgeTiles) -> Linearised:
    """Normal equations at poses ``(W, 4, 4)`` and inverse depths ``(1, B, L)``."""
    T_rel, Rt = relative_motions(T_c_w, layout.host, layout.target, layout.dtype)
    return as_system(T_rel, layout, edge_weights(Rt, x.to(layout.dtype), pairs), prior.at(x))


def edge_cost(Rt: Tensor, x: Tensor, pairs: EdgeTiles) -> Tensor:
    """Robust cost ``()``; arguments as `edge_weights` takes them."""
    g = pair_geometry(Rt, pairs.ray, x[0, :, None])
    value, _ = robust_sum(alignment_row(g, pairs.line), g.front, pairs.robust)
    if pairs.form is CycleForm.RELATIVE_DEPTH:
        value = value + robust_sum(relative_depth_row(g, pairs.held) * pairs.cycle_weight, g.front, pairs.robust)[0]
    elif pairs.form is CycleForm.PIXEL:
        r = round_trip_row(g, Rt, pairs.ray, pairs.held, pairs.K) * pairs.cycle_weight
        value = value + robust_sum(r, g.front, pairs.robust)[0]
    return value


def alignment_chi2(Rt: Tensor, x: Tensor, pairs: EdgeTiles) -> Tensor:
    """Squared whitened alignment residuals ``(B, T, L)``; arguments as `edge_weights` takes them."""
    g = pair_geometry(Rt, pairs.ray, x[0, :, None])
    r = alignment_row(g, pairs.line)
    return torch.where(g.front, r * r, torch.inf).double()


class EdgeBlocks(RelativeBlocks):
    """Edge pixels: alignment across the edge and the depth cycle, one inverse depth each."""

    size = 1
    system_kernel = staticmethod(edge_system)
    cost_kernel = staticmethod(edge_cost)
    prior: EdgePrior
    pairs: EdgeTiles

    def __init__(self, terms: EdgeTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Arrange the terms in the solver's layout; ``K`` is fx, fy, cx, cy."""
        dtype = torch.float32 if config.float32_blocks else torch.float64
        start = np.asarray(terms.inverse_depth, dtype=np.float64)[None]
        super().__init__(terms.host, terms.pair_edge, terms.pair_pose, start, column, config, dtype)
        tiles = self.tiles
        f, c = K[:2].cpu().numpy(), K[2:].cpu().numpy()
        sigma = np.asarray(terms.prior_sigma, dtype=np.float64)
        known = np.isfinite(sigma)
        self.prior = EdgePrior(
            mean=tiles.blocks(np.where(known, terms.prior, 0.0)[None], torch.float64),
            weight=tiles.blocks(np.where(known, sigma, np.inf)[None] ** -2.0, torch.float64),
        )
        # Coordinates first, as contiguous rows.
        partner, normal = (_tensor(np.asarray(x).reshape(-1, 2).T) for x in (terms.pair_uv, terms.pair_normal))
        line = partner_line(partner, normal, _tensor(terms.pair_inv_sigma), K)
        held = np.asarray(terms.pair_inverse_depth, dtype=np.float64)
        used = (held > 0) & (terms.cycle_sigma > 0)
        self.pairs = EdgeTiles(
            ray=tiles.blocks(((np.asarray(terms.uv).reshape(-1, 2) - c) / f).T, dtype)[:, :, None],
            line=tiles.pairs(line.cpu().numpy(), dtype),
            held=tiles.pairs(np.where(held > 0, held, 1.0), dtype, 1.0),
            cycle_weight=tiles.pairs(used / max(terms.cycle_sigma, 1e-300), dtype),
            K=K.to(dtype),
            form=terms.cycle if used.any() else None,
            robust=self.robust(),
        )

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        return ((x - self.prior.mean).square() * self.prior.weight).sum()

    def alignment_chi2(self, T_c_w: Tensor, x: Tensor) -> FloatArray:
        """Squared whitened alignment residuals in the caller's order ``(P,)``; infinite behind the camera."""
        chi2 = kernel(alignment_chi2, self.compile)
        return self.tiles.of_pairs(chi2(self.motions(T_c_w)[1], x.to(self.dtype), self.pairs))


def _tensor(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(x, dtype=np.float64))
