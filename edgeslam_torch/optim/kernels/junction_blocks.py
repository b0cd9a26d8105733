"""L-junctions in the window: corner, arms or angle, and the straightness of the arms, three inverse depths each.

Paper eqs. (24) to (27); the rows and their derivatives are `losses.lshape`'s.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.lshape import junction_residuals, junction_rows
from edgeslam_torch.optim.kernels import schur
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
from edgeslam_torch.optim.problem import JunctionTerms, LmConfig
from edgeslam_torch.types import FloatArray


class JunctionPairs(NamedTuple):
    """Junctions and what the views that see them measured, in tiles."""

    rays: Tensor
    """``(2, 3, B, 1, L)`` normalised coordinates of corner and arm ends in the host."""
    uv: Tensor
    """``(2, B, T, L)`` the corner in the target [px]."""
    arms: Tensor
    """``(2, 2, B, T, L)`` unit directions of the arms there."""
    weight: Tensor
    """``(rows, B, T, L)`` inverse standard deviations; 0 where there is no pair."""
    K: Tensor
    """fx, fy, cx, cy."""
    cosines: bool
    """Whether the angle's cosine is compared instead of the arms' directions."""
    robust: Robust


class JunctionPrior(NamedTuple):
    """Prior on the inverse depths."""

    mean: Tensor
    """``(3, B, L)``."""
    information: Tensor
    """``(3, 3, B, L)``."""

    def at(self, x: Tensor) -> Known:
        """At inverse depths ``(3, B, L)``."""
        e = x - self.mean
        g = (self.information * e).sum(1)
        V = torch.stack([self.information[i, j] for i in range(3) for j in range(i, 3)])
        return Known(V, g, (g * e).sum())


def junction_weights(Rt: Tensor, x: Tensor, pairs: JunctionPairs) -> Weighed:
    """Corner and angle rows at relative motions ``(3, 4, B, T, 1)`` and inverse depths ``(3, B, L)``."""
    r, J, Jd, front = junction_rows(Rt, pairs.rays, x[:, :, None], pairs.uv, pairs.arms, pairs.K, pairs.cosines)
    r = r * pairs.weight
    value, root = robust_sum(r, front, pairs.robust)
    white = (root * pairs.weight)[:, None]
    J = torch.cat((J * white, (r * root)[:, None]), 1)
    return Weighed(*schur.pair_products([row.unbind(0) for row in J], [row.unbind(0) for row in Jd * white]), value)


def junction_system(T_c_w: Tensor, x: Tensor, layout: Layout, prior: JunctionPrior, pairs: JunctionPairs) -> Linearised:
    """Normal equations at poses ``(W, 4, 4)`` and inverse depths ``(3, B, L)``."""
    T_rel, Rt = relative_motions(T_c_w, layout.host, layout.target, layout.dtype)
    return as_system(T_rel, layout, junction_weights(Rt, x.to(layout.dtype), pairs), prior.at(x))


def junction_cost(Rt: Tensor, x: Tensor, pairs: JunctionPairs) -> Tensor:
    """Robust cost ``()``; arguments as `junction_weights` takes them."""
    r, front = junction_residuals(Rt, pairs.rays, x[:, :, None], pairs.uv, pairs.arms, pairs.K, pairs.cosines)
    return robust_sum(r * pairs.weight, front, pairs.robust)[0]


class JunctionBlocks(RelativeBlocks):
    """L-junctions: corner, arms or angle, and the straightness of the arms, three inverse depths each."""

    size = 3
    system_kernel = staticmethod(junction_system)
    cost_kernel = staticmethod(junction_cost)
    prior: JunctionPrior
    pairs: JunctionPairs
    compiles = False
    """A window has some dozens; compiling them took 60 s of CPU time, two thirds of the whole."""

    def __init__(self, terms: JunctionTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Arrange the terms in the solver's layout; ``K`` is fx, fy, cx, cy."""
        double = torch.float64
        start = np.asarray(terms.inverse_depth, dtype=np.float64).reshape(-1, 3).T
        super().__init__(terms.host, terms.pair_junction, terms.pair_pose, start, column, config, double)
        tiles = self.tiles
        rays = (np.asarray(terms.uv).reshape(-1, 3, 2) - K[2:].cpu().numpy()) / K[:2].cpu().numpy()
        information = np.asarray(terms.prior_information).reshape(-1, 3, 3)
        self.prior = JunctionPrior(
            mean=tiles.blocks(np.asarray(terms.prior).reshape(-1, 3).T, double),
            information=tiles.blocks(information.transpose(1, 2, 0), double),
        )
        rows = [terms.inv_sigma_px] * 2 + [terms.inv_sigma_angle] * (1 if terms.cosines else 2)
        taken = tiles.pairs(np.ones(len(terms.pair_pose)), double)
        self.pairs = JunctionPairs(
            rays=tiles.blocks(rays.transpose(2, 1, 0), double)[:, :, :, None],
            uv=tiles.pairs(np.asarray(terms.pair_uv).reshape(-1, 2).T, double),
            arms=tiles.pairs(np.asarray(terms.pair_arms).reshape(-1, 2, 2).transpose(2, 1, 0), double),
            weight=torch.tensor(rows, dtype=double)[:, None, None, None] * taken,
            K=K,
            cosines=terms.cosines,
            robust=self.robust(),
        )

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        return self.prior.at(x).cost


def collinearity_prior(
    fraction: FloatArray, inverse_depth: FloatArray, sigma: FloatArray, weak_sigma: float = 10.0
) -> tuple[FloatArray, FloatArray]:
    """Straight arms through the depths of their edge points: prior of a `JunctionTerms`, paper eq. (26).

    A straight line in space has inverse depths that are linear along its image, so the arm is a line fitted to the
    inverse depths of its points; their scatter about it is the collinearity residual.

    Args:
        fraction: Position of each point along its arm ``(C, 2, M)``, 0 at the corner and 1 at the arm's end; NaN
            without a point.
        inverse_depth: Their inverse depths ``(C, 2, M)`` [1/m].
        sigma: Their standard deviations ``(C, 2, M)`` [1/m].
        weak_sigma: Weak prior for junctions without points [1/m].

    Returns:
        Expected inverse depths of corner and arm ends ``(C, 3)`` and their information ``(C, 3, 3)``.
    """
    s = np.asarray(fraction, dtype=np.float64)
    given = np.isfinite(s) & np.isfinite(inverse_depth) & (np.asarray(sigma) > 0)
    s = np.where(given, s, 0.0)
    w = np.where(given, 1.0 / np.where(given, sigma, 1.0), 0.0)
    z = np.where(given, inverse_depth, 0.0)
    A = np.zeros((*s.shape, 3))
    A[..., 0] = 1.0 - s
    A[:, 0, :, 1], A[:, 1, :, 2] = s[:, 0], s[:, 1]
    A = (A * w[..., None]).reshape(len(s), -1, 3)
    right = (z * w).reshape(len(s), -1)
    mean = z.sum((1, 2)) / np.maximum(given.sum((1, 2)), 1)
    weak = 1.0 / weak_sigma**2
    information = np.einsum("cki,ckj->cij", A, A) + weak * np.eye(3)
    moment = np.einsum("cki,ck->ci", A, right) + weak * mean[:, None]
    return np.linalg.solve(information, moment[..., None])[..., 0], information
