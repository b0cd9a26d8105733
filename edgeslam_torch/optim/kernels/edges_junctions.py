"""Edges and junctions: blocks anchored in a host pose and observed from target poses.

Residuals are differentiated by the *relative* pose of host and target, six columns, whatever the window's size;
blocks are eliminated in those columns, one dense product per tile of blocks (`optim.kernels.tiles`); only then does the
adjoint map them to the two poses: ``xi_rel = xi_target - Ad(T_target_host) xi_host``.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
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
from edgeslam_torch.losses.lshape import junction_residuals, junction_rows
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim.kernels import schur
from edgeslam_torch.optim.kernels.compiled import kernel
from edgeslam_torch.optim.kernels.tiles import lay_out
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms, LmConfig
from edgeslam_torch.types import FloatArray, IntArray

INVERSE_DEPTH_MIN = 1e-4
"""Lower bound of refined inverse depths: practically at infinity, never behind the camera."""


class RelativeSystem(NamedTuple):
    """Normal equations of blocks at one state."""

    V: Tensor
    """Upper triangles of the blocks ``(size (size + 1) / 2, B, L)``."""
    g: Tensor
    """Their gradients ``(size, B, L)``."""
    cross: Tensor
    """Their coupling with the relative poses ``(B, T, 6, size, L)``."""
    map: Tensor
    """Tangents of the relative poses by those of the free poses ``(B, 6 T, 6 F)``."""


class Eliminated(NamedTuple):
    """Blocks eliminated from the pose system, for back-substitution."""

    factor: Tensor
    """Inverse Cholesky factors, shaped as `RelativeSystem.V`."""
    y: Tensor
    """Whitened gradients ``(size, B, L)``."""
    Y_T: Tensor
    """``(B, size L, 6 T)``."""


class Layout(NamedTuple):
    """Tiles and the poses they belong to."""

    host: Tensor
    """``(B,)`` hosts."""
    target: Tensor
    """``(B, T)`` targets."""
    host_column: Tensor
    """``(B,)`` free-pose numbers of the hosts, ``F`` for a fixed pose."""
    target_column: Tensor
    """``(B T,)`` the same of the targets."""
    free: int
    """``F``."""
    dtype: torch.dtype
    """Of the blocks."""


class RelativeBlocks(ABC):
    """Host-anchored blocks of ``size`` inverse depths; subclasses write the residual rows.

    Pairs are kept in tiles: ``B`` tiles of ``T`` targets by ``L`` blocks, values of blocks ``(size, B, L)``.
    """

    size: int

    def __init__(
        self,
        host: IntArray,
        pair_block: IntArray,
        pair_pose: IntArray,
        inverse_depth: FloatArray,
        column: Tensor,
        config: LmConfig,
        dtype: torch.dtype,
    ) -> None:
        """Lay out.

        Args:
            host: ``(E,)`` host poses.
            pair_block: ``(P,)`` blocks of the pairs.
            pair_pose: ``(P,)`` target poses.
            inverse_depth: ``(size, E)`` start.
            column: ``(W,)`` free-pose number of each pose, -1 for a fixed one.
            config: Kernel and its width.
            dtype: Of the blocks.
        """
        self.config, self.dtype = config, dtype
        self.tiles = lay_out(host, pair_block, pair_pose, len(column))
        self.x = self.tiles.blocks(np.maximum(inverse_depth, INVERSE_DEPTH_MIN), torch.float64, 1.0)
        # Cost of a pair behind a camera; empty slots cost nothing.
        self.far = self.tiles.pairs(np.full(len(pair_block), config.behind_px**2), dtype)
        F = int((column >= 0).sum())
        column = torch.where(column < 0, F, column)  # fixed poses share a last column that is cut off
        self.layout = Layout(
            self.tiles.host, self.tiles.target, column[self.tiles.host], column[self.tiles.target].flatten(), F, dtype
        )

    @abstractmethod
    def system(self, T_c_w: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        """What `_as_system` returns, at poses ``(W, 4, 4)`` and blocks ``(size, B, L)``."""

    @abstractmethod
    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()`` of the residual rows, at motions ``(3, 4, B, T, 1)``."""

    @abstractmethod
    def prior_cost(self, x: Tensor) -> Tensor:
        """Cost ``()`` of the priors on the blocks ``(size, B, L)``."""

    def motions(self, T_c_w: Tensor) -> tuple[Tensor, Tensor]:
        """Relative motions ``(B T, 4, 4)``, and in the blocks' precision ``(3, 4, B, T, 1)``."""
        motions = kernel(relative_motions, self.config.compile)
        out: tuple[Tensor, Tensor] = motions(T_c_w, self.tiles.host, self.tiles.target, self.dtype)
        return out

    def cost(self, T_c_w: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()``."""
        return self.robust_cost(self.motions(T_c_w)[1], x.to(self.dtype)) + self.prior_cost(x)

    def linearise(self, T_c_w: Tensor, x: Tensor, H: Tensor, g: Tensor) -> tuple[RelativeSystem, Tensor]:
        """Normal equations and cost ``()``; adds the poses' own part to ``H (6F, 6F)`` and ``g (6F,)``."""
        *system, H_add, g_add, value = self.system(T_c_w, x)
        H += H_add
        g += g_add
        return RelativeSystem(*system), value

    def reduce(self, system: RelativeSystem, mu: float, S: Tensor, b: Tensor) -> Eliminated:
        """Eliminate the blocks from the pose system ``S`` and its right side ``b``."""
        damping = torch.tensor(mu, dtype=torch.float64)
        *eliminated, taken, right = kernel(taken_out, self.config.compile)(system, damping)
        S -= taken
        b -= right
        return Eliminated(*eliminated)

    def step(self, system: RelativeSystem, eliminated: Eliminated, delta: Tensor) -> Tensor:
        """Back-substitution: step of the blocks ``(size, B, L)`` for the poses' ``delta (6F,)``."""
        B, _, L = self.tiles.shape
        moved = (eliminated.Y_T @ (system.map @ delta).to(self.dtype)[..., None]).view(B, self.size, L)
        return schur.unwhiten(eliminated.factor, -eliminated.y - moved.transpose(0, 1))

    def _kernel(self) -> tuple[Tensor, Kernel, float]:
        """Cost of what lies behind a camera, the kernel and its width."""
        return self.far, self.config.kernel, self.config.edge_delta


def relative_motions(T_c_w: Tensor, host: Tensor, target: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """See `RelativeBlocks.motions`; poses ``(W, 4, 4)``, hosts ``(B,)`` and targets ``(B, T)``."""
    T = T_c_w[target] @ lie.inverse(T_c_w)[host, None]
    return T.flatten(0, 1), T[..., :3, :].permute(2, 3, 0, 1)[..., None].to(dtype).contiguous()


def taken_out(system: RelativeSystem, damping: Tensor) -> tuple[Tensor, ...]:
    """The fields of `Eliminated`, and the Schur terms to subtract from the pose system ``(6F, 6F)`` and its right
    side."""
    factor, y, Y_T, taken, right = schur.eliminate(system.V, system.g, system.cross, damping)
    flat = system.map.flatten(0, 1)
    return factor, y, Y_T, flat.mT @ (taken @ system.map).flatten(0, 1), flat.mT @ right.flatten()


def mapped(T_rel: Tensor, normal: Tensor, host: Tensor, target: Tensor, F: int) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations of the relative poses, mapped to the free poses.

    Args:
        T_rel: Relative motions ``(B T, 4, 4)``.
        normal: Their normal matrices and gradients ``(B, T, 7, 7)``.
        host: Free-pose numbers ``(B,)`` of the hosts, ``F`` for a fixed pose.
        target: The same of the targets ``(B T,)``.
        F: Number of free poses.

    Returns:
        Tangents of the relative poses by those of the free poses ``(B, 6 T, 6 F)``, and what to add to the pose
        system ``(6 F, 6 F)`` and its gradient ``(6 F,)``.
    """
    B, T = normal.shape[:2]
    G, n = B * T, 6 * F
    numbers = torch.arange(F, device=host.device)
    of_host = host[:, None, None].expand(B, T, F).reshape(G, F) == numbers
    by_host = of_host[:, None, :, None] * lie.adjoint(T_rel)[:, :, None]
    eye = torch.eye(6, dtype=T_rel.dtype, device=host.device)
    by_target = (target[:, None] == numbers)[:, None, :, None] * eye[:, None]
    M = (by_target - by_host).view(G, 6, n)
    flat, N = M.view(6 * G, n), normal.double().view(G, 7, 7)
    H = flat.mT @ (N[:, :6, :6] @ M).view(6 * G, n)
    return M.view(B, 6 * T, n), H, flat.mT @ N[:, :6, 6].flatten()


def _as_system(
    T_rel: Tensor, layout: Layout, weighed: tuple[Tensor, ...], V_prior: Tensor, g_prior: Tensor, cost_prior: Tensor
) -> tuple[Tensor, ...]:
    """The fields of `RelativeSystem`, what to add to the pose system and its gradient, and the cost ``()``.

    Args:
        T_rel: Relative motions ``(B T, 4, 4)``.
        layout: The tiles.
        weighed: `schur.pair_products` of the weighted rows, and their cost.
        V_prior: Prior information of the blocks, as upper triangles.
        g_prior: Its gradients ``(size, B, L)``.
        cost_prior: Its cost ``()``.
    """
    normal, cross, V, g, value = weighed
    to_relative, H, g_pose = mapped(T_rel, normal, layout.host_column, layout.target_column, layout.free)
    return V.double() + V_prior, g.double() + g_prior, cross, to_relative, H, g_pose, value + cost_prior


def _robust(r: Tensor, front: Tensor, far: Tensor, robust: Kernel, delta: float) -> tuple[Tensor, Tensor]:
    """Robust cost ``()`` in double precision of whitened residuals ``(..., B, T, L)`` and the roots of their weights.

    Pairs behind the camera cost ``far`` and have zero weight.
    """
    value, weight = rho(torch.where(front, r * r, far), robust, delta)
    # Short sums in the rows' precision, the long sum in double.
    return value.sum(-1).sum(dtype=torch.float64), torch.where(front, weight.sqrt(), 0.0)


def edge_weights(
    Rt: Tensor,
    x: Tensor,
    ray: Tensor,
    line: Tensor,
    held: Tensor,
    cycle_weight: Tensor,
    K: Tensor,
    form: CycleForm | None,
    far: Tensor,
    robust: Kernel,
    delta: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`schur.pair_products` of the alignment and cycle rows of edge pairs, and their cost ``()``.

    Arguments are relative motions ``(3, 4, B, T, 1)``, blocks ``(1, B, L)`` and `EdgeBlocks`' own tensors.
    """
    x = x[0, :, None]
    g = pair_geometry(Rt, ray, x)
    slope = depth_slopes(g, Rt[:, 3])
    r = alignment_row(g, line)
    value, root = _robust(r, g.front, far, robust, delta)
    by_pose, by_depth = alignment_jacobians(g, slope, line * root)
    J, Jd = [(*by_pose, r * root)], [(by_depth,)]
    if form is CycleForm.RELATIVE_DEPTH:
        r = relative_depth_row(g, held) * cycle_weight
        cost, root = _robust(r, g.front, far, robust, delta)
        value = value + cost
        by_pose, by_depth = relative_depth_jacobians(g, slope, held, cycle_weight * root)
        J.append((*by_pose, r * root))
        Jd.append((by_depth,))
    elif form is CycleForm.PIXEL:
        r, by_poses, by_depths = round_trip_jacobians(g, slope, Rt, ray, held, K)
        r = r * cycle_weight
        cost, root = _robust(r, g.front, far, robust, delta)
        value = value + cost
        for k in range(2):
            J.append((*(by_poses[k] * (cycle_weight * root[k])).unbind(0), r[k] * root[k]))
            Jd.append((by_depths[k] * (cycle_weight * root[k]),))
    return *schur.pair_products(J, Jd), value


def edge_system(
    T_c_w: Tensor,
    x: Tensor,
    layout: Layout,
    prior: Tensor,
    prior_weight: Tensor,
    *given: Tensor | CycleForm | Kernel | float | None,
) -> tuple[Tensor, ...]:
    """`_as_system` of edges; ``given`` are the arguments of `edge_weights` after the first two."""
    T_rel, Rt = relative_motions(T_c_w, layout.host, layout.target, layout.dtype)
    e = x - prior
    g = prior_weight * e
    weighed = edge_weights(Rt, x.to(layout.dtype), *given)  # type: ignore[arg-type]
    return _as_system(T_rel, layout, weighed, prior_weight, g, (g * e).sum())


def edge_cost(
    Rt: Tensor,
    x: Tensor,
    ray: Tensor,
    line: Tensor,
    held: Tensor,
    cycle_weight: Tensor,
    K: Tensor,
    form: CycleForm | None,
    far: Tensor,
    robust: Kernel,
    delta: float,
) -> Tensor:
    """Robust cost ``()`` of edge pairs; arguments as `edge_weights` takes them."""
    g = pair_geometry(Rt, ray, x[0, :, None])
    value, _ = _robust(alignment_row(g, line), g.front, far, robust, delta)
    if form is CycleForm.RELATIVE_DEPTH:
        value = value + _robust(relative_depth_row(g, held) * cycle_weight, g.front, far, robust, delta)[0]
    elif form is CycleForm.PIXEL:
        r = round_trip_row(g, Rt, ray, held, K) * cycle_weight
        value = value + _robust(r, g.front, far, robust, delta)[0]
    return value


def alignment_chi2(Rt: Tensor, x: Tensor, ray: Tensor, line: Tensor) -> Tensor:
    """Squared whitened alignment residuals ``(B, T, L)``; arguments as `edge_weights` takes them."""
    g = pair_geometry(Rt, ray, x[0, :, None])
    r = alignment_row(g, line)
    return torch.where(g.front, r * r, torch.inf).double()


def junction_weights(
    Rt: Tensor,
    x: Tensor,
    rays: Tensor,
    uv: Tensor,
    arms: Tensor,
    weight: Tensor,
    K: Tensor,
    cosines: bool,
    far: Tensor,
    robust: Kernel,
    delta: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`schur.pair_products` of the corner and angle rows of junction pairs, and their cost ``()``.

    Arguments are relative motions ``(3, 4, B, T, 1)``, blocks ``(3, B, L)`` and `JunctionBlocks`' own tensors.
    """
    r, J, Jd, front = junction_rows(Rt, rays, x[:, :, None], uv, arms, K, cosines)
    r = r * weight
    value, root = _robust(r, front, far, robust, delta)
    white = (root * weight)[:, None]
    J = torch.cat((J * white, (r * root)[:, None]), 1)
    return *schur.pair_products([row.unbind(0) for row in J], [row.unbind(0) for row in Jd * white]), value


def junction_system(
    T_c_w: Tensor,
    x: Tensor,
    layout: Layout,
    prior: Tensor,
    information: Tensor,
    *given: Tensor | bool | Kernel | float,
) -> tuple[Tensor, ...]:
    """`_as_system` of junctions; ``given`` are the arguments of `junction_weights` after the first two."""
    T_rel, Rt = relative_motions(T_c_w, layout.host, layout.target, layout.dtype)
    e = x - prior
    g = (information * e).sum(1)
    weighed = junction_weights(Rt, x.to(layout.dtype), *given)  # type: ignore[arg-type]
    V = torch.stack([information[i, j] for i in range(3) for j in range(i, 3)])
    return _as_system(T_rel, layout, weighed, V, g, (g * e).sum())


def junction_cost(
    Rt: Tensor,
    x: Tensor,
    rays: Tensor,
    uv: Tensor,
    arms: Tensor,
    weight: Tensor,
    K: Tensor,
    cosines: bool,
    far: Tensor,
    robust: Kernel,
    delta: float,
) -> Tensor:
    """Robust cost ``()`` of junction pairs; arguments as `junction_weights` takes them."""
    r, front = junction_residuals(Rt, rays, x[:, :, None], uv, arms, K, cosines)
    return _robust(r * weight, front, far, robust, delta)[0]


class EdgeBlocks(RelativeBlocks):
    """Edge pixels: alignment across the edge and the depth cycle, one inverse depth each."""

    size = 1

    def __init__(self, terms: EdgeTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Arrange the terms in the solver's layout; ``K`` is fx, fy, cx, cy."""
        dtype = torch.float32 if config.float32_blocks else torch.float64
        start = np.asarray(terms.inverse_depth, dtype=np.float64)[None]
        super().__init__(terms.host, terms.pair_edge, terms.pair_pose, start, column, config, dtype)
        tiles = self.tiles
        self.K = K.to(dtype)
        f, c = K[:2].cpu().numpy(), K[2:].cpu().numpy()
        self.ray = tiles.blocks(((np.asarray(terms.uv).reshape(-1, 2) - c) / f).T, dtype)[:, :, None]
        sigma = np.asarray(terms.prior_sigma, dtype=np.float64)
        known = np.isfinite(sigma)
        self.prior_weight = tiles.blocks(np.where(known, sigma, np.inf)[None] ** -2.0, torch.float64)
        self.prior = tiles.blocks(np.where(known, terms.prior, 0.0)[None], torch.float64)
        # Coordinates first, as contiguous rows.
        partner, normal = (_tensor(np.asarray(x).reshape(-1, 2).T) for x in (terms.pair_uv, terms.pair_normal))
        line = partner_line(partner, normal, _tensor(terms.pair_inv_sigma), K)
        self.line = tiles.pairs(line.cpu().numpy(), dtype)
        held = np.asarray(terms.pair_inverse_depth, dtype=np.float64)
        used = (held > 0) & (terms.cycle_sigma > 0)
        self.held = tiles.pairs(np.where(held > 0, held, 1.0), dtype, 1.0)
        self.cycle_weight = tiles.pairs(used / max(terms.cycle_sigma, 1e-300), dtype)
        self.form = terms.cycle if used.any() else None

    def _given(self) -> tuple[Tensor | CycleForm | Kernel | float | None, ...]:
        return self.ray, self.line, self.held, self.cycle_weight, self.K, self.form, *self._kernel()

    def system(self, T_c_w: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        """See `RelativeBlocks.system`."""
        linear = kernel(edge_system, self.config.compile)
        out: tuple[Tensor, ...] = linear(T_c_w, x, self.layout, self.prior, self.prior_weight, *self._given())
        return out

    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """See `RelativeBlocks.robust_cost`."""
        out: Tensor = kernel(edge_cost, self.config.compile)(Rt, x, *self._given())
        return out

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        return ((x - self.prior).square() * self.prior_weight).sum()

    def alignment_chi2(self, T_c_w: Tensor, x: Tensor) -> FloatArray:
        """Squared whitened alignment residuals in the caller's order ``(P,)``; infinite behind the camera."""
        chi2 = kernel(alignment_chi2, self.config.compile)
        return self.tiles.of_pairs(chi2(self.motions(T_c_w)[1], x.to(self.dtype), self.ray, self.line))


class JunctionBlocks(RelativeBlocks):
    """L-junctions: corner, arms or angle, and the straightness of the arms, three inverse depths each."""

    size = 3

    def __init__(self, terms: JunctionTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Take the terms into the solver's layout; ``K`` is fx, fy, cx, cy."""
        double = torch.float64
        start = np.asarray(terms.inverse_depth, dtype=np.float64).reshape(-1, 3).T
        super().__init__(terms.host, terms.pair_junction, terms.pair_pose, start, column, config, double)
        tiles = self.tiles
        self.K, self.cosines = K, terms.cosines
        rays = (np.asarray(terms.uv).reshape(-1, 3, 2) - K[2:].cpu().numpy()) / K[:2].cpu().numpy()
        self.rays = tiles.blocks(rays.transpose(2, 1, 0), double)[:, :, :, None]
        self.prior = tiles.blocks(np.asarray(terms.prior).reshape(-1, 3).T, double)
        information = np.asarray(terms.prior_information).reshape(-1, 3, 3)
        self.information = tiles.blocks(information.transpose(1, 2, 0), double)
        self.uv = tiles.pairs(np.asarray(terms.pair_uv).reshape(-1, 2).T, double)
        self.arms = tiles.pairs(np.asarray(terms.pair_arms).reshape(-1, 2, 2).transpose(2, 1, 0), double)
        rows = [terms.inv_sigma_px] * 2 + [terms.inv_sigma_angle] * (1 if terms.cosines else 2)
        taken = tiles.pairs(np.ones(len(terms.pair_pose)), double)
        self.weight = torch.tensor(rows, dtype=double)[:, None, None, None] * taken

    def _given(self) -> tuple[Tensor | bool | Kernel | float, ...]:
        return self.rays, self.uv, self.arms, self.weight, self.K, self.cosines, *self._kernel()

    def system(self, T_c_w: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        """See `RelativeBlocks.system`."""
        linear = kernel(junction_system, self.config.compile)
        out: tuple[Tensor, ...] = linear(T_c_w, x, self.layout, self.prior, self.information, *self._given())
        return out

    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """See `RelativeBlocks.robust_cost`."""
        out: Tensor = kernel(junction_cost, self.config.compile)(Rt, x, *self._given())
        return out

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        e = x - self.prior
        return ((self.information * e).sum(1) * e).sum()


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


def _tensor(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(x, dtype=np.float64))
