"""Edges and junctions: blocks that live in a host pose and are seen from target poses.

Residuals are differentiated by the *relative* pose of host and target, six columns, whatever the window's size;
blocks are eliminated in those columns, one dense product per host; only then does the adjoint map them to the two
poses: ``xi_rel = xi_target - Ad(T_target_host) xi_host``.
"""

from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.edge_alignment import (
    alignment_jacobians,
    alignment_row,
    pair_geometry,
    relative_depth_jacobians,
    relative_depth_row,
    round_trip_jacobians,
)
from edgeslam_torch.losses.lshape import junction_rows
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim import lie, schur
from edgeslam_torch.optim.compiled import kernel
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms, LmConfig
from edgeslam_torch.types import FloatArray, IntArray

INVERSE_DEPTH_MIN = 1e-4
"""Nothing is refined beyond this inverse depth: practically at infinity, and never behind the camera."""


class RelativeBlocks(ABC):
    """Host-anchored blocks of ``size`` inverse depths; subclasses write the residual rows.

    Blocks are kept sorted by host, pairs by host, target, block.
    """

    size: int

    def __init__(
        self,
        host: IntArray,
        pair_block: IntArray,
        pair_pose: IntArray,
        column: Tensor,
        config: LmConfig,
        dtype: torch.dtype,
    ) -> None:
        """Sort and lay out.

        Args:
            host: ``(E,)`` host poses.
            pair_block: ``(P,)`` blocks of the pairs.
            pair_pose: ``(P,)`` target poses.
            column: ``(W,)`` free-pose number of each pose, -1 for a fixed one.
            config: Kernel and its width.
            dtype: Of the blocks.
        """
        self.config, self.dtype = config, dtype
        self._seen: tuple[Tensor, Tensor, Tensor] | None = None
        self.column = torch.where(column < 0, int((column >= 0).sum()), column)
        hosts = torch.as_tensor(np.asarray(host, dtype=np.int64))
        E, W = len(hosts), len(column)
        self.block_order = torch.argsort(hosts, stable=True)
        rank = torch.empty_like(self.block_order)
        rank[self.block_order] = torch.arange(E)
        block = rank[torch.as_tensor(np.asarray(pair_block, dtype=np.int64))]
        target = torch.as_tensor(np.asarray(pair_pose, dtype=np.int64))
        pair_host = hosts[self.block_order][block]
        if bool((pair_host == target).any()):
            raise ValueError("a pair's target pose must differ from its host")
        key = pair_host * W + target
        self.pair_order = torch.argsort(key * max(E, 1) + block)
        self.block = block[self.pair_order]
        groups, self.group = torch.unique_consecutive(key[self.pair_order], return_inverse=True)
        self.group_host, self.group_target = groups // W, groups % W
        self.n_blocks = E
        bounds = [0, *torch.bincount(hosts, minlength=W).cumsum(0).tolist()]
        self.chunks = schur.plan_chunks(self.group, self.block, bounds, self.size)
        self.Y = [torch.zeros(len(c.columns), self.size * (c.last - c.first), dtype=dtype) for c in self.chunks]

    @abstractmethod
    def weigh(self, Rt: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weighted rows at motions ``(3, 4, P)`` and block values ``(size, P)``, see `_weighted`."""

    @abstractmethod
    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()`` of the rows alone; arguments as `weigh` takes them."""

    @abstractmethod
    def prior_cost(self, x: Tensor) -> Tensor:
        """Cost ``()`` of what is known about the blocks ``(size, E)`` beforehand."""

    @abstractmethod
    def add_prior(self, x: Tensor, V: Tensor, g: Tensor) -> None:
        """Add the prior to the blocks' normal matrices and gradients ``(size, E)``."""

    def motions(self, T_c_w: Tensor) -> tuple[Tensor, Tensor]:
        """Relative motions of the groups ``(G, 4, 4)`` and of the pairs ``(3, 4, P)``; kept for the same poses."""
        if self._seen is not None and self._seen[0] is T_c_w:
            return self._seen[1:]
        T = T_c_w[self.group_target] @ lie.inverse(T_c_w[self.group_host])
        flat = T[:, :3].permute(1, 2, 0).reshape(12, -1).to(self.dtype)
        self._seen = (T_c_w, T, flat.index_select(1, self.group).view(3, 4, -1))
        return self._seen[1:]

    def cost(self, T_c_w: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()``."""
        if len(self.block) == 0:
            return self.prior_cost(x)
        pairs = x.index_select(1, self.block).to(self.dtype)
        return self.robust_cost(self.motions(T_c_w)[1], pairs) + self.prior_cost(x)

    def linearise(self, T_c_w: Tensor, x: Tensor, H: Tensor, g: Tensor) -> Tensor:
        """Prepare the blocks; add the pose part to ``H (6F, 6F)`` and ``g (6F,)``; returns the cost ``()``."""
        sums = torch.zeros(self.size * (self.size + 1) // 2 + self.size, self.n_blocks, dtype=torch.float64)
        cost = self.prior_cost(x)
        if len(self.block):
            T_rel, Rt = self.motions(T_c_w)
            self.J, self.Jd, own, value = self.weigh(Rt, x.index_select(1, self.block).to(self.dtype))
            cost = cost + value
            sums.index_add_(1, self.block, own)
            self._add_poses(T_rel, H, g)
        self.V, self.g = sums[: -self.size], sums[-self.size :]
        self.add_prior(x, self.V, self.g)
        return cost

    def _add_poses(self, T_rel: Tensor, H: Tensor, g: Tensor) -> None:
        """Normal matrices of the relative poses, mapped to the poses."""
        G, n = len(T_rel), H.shape[0]
        normal = torch.empty(G, 7, 7, dtype=self.dtype)
        for chunk in self.chunks:
            for group, lo, hi in chunk.slices:
                out = normal[group]
                part = self.J[0, :, lo:hi]
                torch.mm(part, part.mT, out=out)
                for k in range(1, self.J.shape[0]):
                    part = self.J[k, :, lo:hi]
                    out.addmm_(part, part.mT)
        normal = normal.double()
        # Tangents of the groups by the poses; fixed poses share a last column that is cut off.
        M = torch.zeros(G, n // 6 + 1, 6, 6, dtype=torch.float64)
        each = torch.arange(G)
        M[each, self.column[self.group_target]] += torch.eye(6, dtype=torch.float64)
        M[each, self.column[self.group_host]] -= lie.adjoint(T_rel)
        M = M[:, :-1].permute(0, 2, 1, 3).reshape(G, 6, n)
        flat = M.reshape(6 * G, n)  # one free pose: not contiguous
        H += flat.mT @ (normal[:, :6, :6] @ M).view(6 * G, n)
        g += flat.mT @ normal[:, :6, 6].flatten()
        self.maps = [flat[6 * c.slices[0][0] : 6 * c.slices[-1][0] + 6] for c in self.chunks]

    def reduce(self, mu: float, S: Tensor, b: Tensor) -> None:
        """Subtract what the blocks take from the pose system ``S`` and its right side ``b``."""
        self.factor = schur.inverse_cholesky(self.V, mu)
        self.y = schur.whiten(self.factor, self.g)
        if len(self.block) == 0:
            return
        entries = kernel(schur.entries, self.config.compile)(
            self.factor.to(self.dtype), self.block, self.J[:, :6], self.Jd
        )
        y = self.y.to(self.dtype)
        for chunk, Y, M in zip(self.chunks, self.Y, self.maps, strict=True):
            schur.fill(Y, chunk, entries[..., chunk.lo : chunk.hi])
            S -= M.mT @ ((Y @ Y.mT).double() @ M)
            b -= M.mT @ (Y @ y[:, chunk.first : chunk.last].flatten()).double()

    def step(self, delta: Tensor) -> Tensor:
        """Step of the blocks ``(size, E)`` that goes with the poses' ``delta (6F,)``."""
        back = -self.y
        if len(self.block):
            for chunk, Y, M in zip(self.chunks, self.Y, self.maps, strict=True):
                moved = ((M @ delta).to(self.dtype) @ Y).view(self.size, -1)
                back[:, chunk.first : chunk.last] -= moved
        return schur.unwhiten(self.factor, back)

    def _kernel(self) -> tuple[Kernel, float, float]:
        """Kernel, its width, and the squared residual of what lies behind a camera."""
        return self.config.kernel, self.config.edge_delta, self.config.behind_px**2


def _weighted(
    J: Tensor, Jd: Tensor, valid: Tensor, robust: Kernel, delta: float, far: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows times the roots of their robust weights.

    Args:
        J: Whitened derivatives by the relative pose with the residual as seventh ``(R, 7, P)``, finite everywhere;
            changed in place.
        Jd: Derivatives by the block ``(R, size, P)``; changed in place.
        valid: ``(P,)``; the others get weight zero and a fixed, large cost.
        robust: Kernel.
        delta: Its width.
        far: Squared residual of a pair behind the camera.

    Returns:
        ``J`` and ``Jd`` weighted, the blocks' own normal matrices and gradients ``(size (size + 1) / 2 + size, P)``
        and the cost ``()``, the latter two in double precision.
    """
    r = J[:, 6]
    value, weight = rho(torch.where(valid, r * r, far), robust, delta)
    root = torch.where(valid, weight.sqrt(), 0.0)
    J, Jd = J.mul_(root[:, None]), Jd.mul_(root[:, None])
    own = torch.cat((schur.triangle(Jd), schur.row_products(Jd, J[:, 6:])[:, 0]))
    return J, Jd, own.double(), value.sum(dtype=torch.float64)


def edge_weights(
    Rt: Tensor,
    x: Tensor,
    ray: Tensor,
    uv: Tensor,
    normal: Tensor,
    inv_sigma: Tensor,
    held: Tensor,
    cycle_weight: Tensor,
    K: Tensor,
    form: CycleForm | None,
    robust: Kernel,
    delta: float,
    far: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Alignment and cycle rows of edge pairs, see `_weighted`; arguments are `EdgeBlocks`' own tensors."""
    g = pair_geometry(Rt, ray, x[0])
    n = 1 if form is None else 3 if form is CycleForm.PIXEL else 2
    J = torch.empty(n, 7, ray.shape[1], dtype=ray.dtype, device=ray.device)
    Jd = torch.empty(n, 1, ray.shape[1], dtype=ray.dtype, device=ray.device)
    _put(J[:1], Jd[:1], inv_sigma, *alignment_jacobians(g, uv, normal, K))
    if form is CycleForm.PIXEL:
        _put(J[1:], Jd[1:], cycle_weight, *round_trip_jacobians(g, Rt, ray, held, K))
    elif form is not None:
        _put(J[1:], Jd[1:], cycle_weight, *relative_depth_jacobians(g, held))
    return _weighted(J, Jd, g.front, robust, delta, far)


def edge_cost(
    Rt: Tensor,
    x: Tensor,
    ray: Tensor,
    uv: Tensor,
    normal: Tensor,
    inv_sigma: Tensor,
    held: Tensor,
    cycle_weight: Tensor,
    K: Tensor,
    form: CycleForm | None,
    robust: Kernel,
    delta: float,
    far: float,
) -> Tensor:
    """Robust cost ``()`` of edge pairs; arguments as `edge_weights` takes them."""
    g = pair_geometry(Rt, ray, x[0])
    parts = [(alignment_row(g, uv, normal, K) * inv_sigma)[None]]
    if form is CycleForm.PIXEL:
        parts.append(round_trip_jacobians(g, Rt, ray, held, K)[0] * cycle_weight)
    elif form is not None:
        parts.append((relative_depth_row(g, held) * cycle_weight)[None])
    value, _ = rho(torch.where(g.front, torch.cat(parts).square(), far), robust, delta)
    return value.sum(dtype=torch.float64)


def junction_weights(
    Rt: Tensor,
    x: Tensor,
    rays: Tensor,
    uv: Tensor,
    arms: Tensor,
    weight: Tensor,
    K: Tensor,
    cosines: bool,
    robust: Kernel,
    delta: float,
    far: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Corner and angle rows of junction pairs, see `_weighted`; arguments are `JunctionBlocks`' own tensors."""
    r, J, Jd, front = junction_rows(Rt, rays, x, uv, arms, K, cosines)
    J = torch.cat((J, r[:, None]), 1) * weight[..., None]
    return _weighted(J, Jd * weight[..., None], front, robust, delta, far)


def junction_cost(
    Rt: Tensor,
    x: Tensor,
    rays: Tensor,
    uv: Tensor,
    arms: Tensor,
    weight: Tensor,
    K: Tensor,
    cosines: bool,
    robust: Kernel,
    delta: float,
    far: float,
) -> Tensor:
    """Robust cost ``()`` of junction pairs; arguments as `junction_weights` takes them."""
    r, _, _, front = junction_rows(Rt, rays, x, uv, arms, K, cosines)
    value, _ = rho(torch.where(front, (r * weight).square(), far), robust, delta)
    return value.sum(dtype=torch.float64)


class EdgeBlocks(RelativeBlocks):
    """Edge pixels: alignment across the edge and the depth cycle, one inverse depth each."""

    size = 1

    def __init__(self, terms: EdgeTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Take the terms into the solver's order; ``K`` is fx, fy, cx, cy."""
        dtype = torch.float32 if config.float32_edges else torch.float64
        super().__init__(terms.host, terms.pair_edge, terms.pair_pose, column, config, dtype)
        self.K = K.to(dtype)
        rays = (_tensor(terms.uv).view(-1, 2) - K[2:]) / K[:2]
        self.ray = rays[self.block_order][self.block].mT.contiguous().to(dtype)
        self.x = _tensor(terms.inverse_depth)[self.block_order].clamp_min(INVERSE_DEPTH_MIN)[None]
        sigma = _tensor(terms.prior_sigma)[self.block_order]
        self.prior_weight = sigma.square().reciprocal()[None]
        self.prior = torch.where(sigma.isfinite(), _tensor(terms.prior)[self.block_order], 0.0)[None]
        order = self.pair_order
        self.uv = _tensor(terms.pair_uv).view(-1, 2)[order].mT.contiguous().to(dtype)
        self.normal = _tensor(terms.pair_normal).view(-1, 2)[order].mT.contiguous().to(dtype)
        self.inv_sigma = _tensor(terms.pair_inv_sigma)[order].to(dtype)
        held = _tensor(terms.pair_inverse_depth)[order].to(dtype)
        self.form = terms.cycle
        self.held = torch.where(held > 0, held, 1.0)
        self.cycle_weight = torch.zeros_like(held)
        if terms.cycle_sigma > 0:
            self.cycle_weight[held > 0] = 1.0 / terms.cycle_sigma
        self.has_cycle = bool((self.cycle_weight > 0).any())

    def _given(self) -> tuple[Tensor | CycleForm | Kernel | float | None, ...]:
        form = self.form if self.has_cycle else None
        given = (self.ray, self.uv, self.normal, self.inv_sigma, self.held, self.cycle_weight, self.K)
        return (*given, form, *self._kernel())

    def weigh(self, Rt: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See `RelativeBlocks.weigh`."""
        out: tuple[Tensor, Tensor, Tensor, Tensor] = kernel(edge_weights, self.config.compile)(Rt, x, *self._given())
        return out

    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """See `RelativeBlocks.robust_cost`."""
        out: Tensor = kernel(edge_cost, self.config.compile)(Rt, x, *self._given())
        return out

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        return ((x - self.prior).square() * self.prior_weight).sum()

    def add_prior(self, x: Tensor, V: Tensor, g: Tensor) -> None:
        """See `RelativeBlocks.add_prior`."""
        V += self.prior_weight
        g += self.prior_weight * (x - self.prior)

    def alignment_chi2(self, T_c_w: Tensor, x: Tensor) -> Tensor:
        """Squared whitened alignment residuals in the caller's order ``(P,)``; infinite behind the camera."""
        g = pair_geometry(self.motions(T_c_w)[1], self.ray, x.index_select(1, self.block).to(self.dtype)[0])
        r = alignment_row(g, self.uv, self.normal, self.K) * self.inv_sigma
        out = torch.empty_like(r)
        out[self.pair_order] = torch.where(g.front, r * r, torch.inf)
        return out.double()


class JunctionBlocks(RelativeBlocks):
    """L-junctions: corner, arms or angle, and the straightness of the arms, three inverse depths each."""

    size = 3

    def __init__(self, terms: JunctionTerms, K: Tensor, column: Tensor, config: LmConfig) -> None:
        """Take the terms into the solver's order; ``K`` is fx, fy, cx, cy."""
        super().__init__(terms.host, terms.pair_junction, terms.pair_pose, column, config, torch.float64)
        self.K, self.cosines = K, terms.cosines
        rays = (_tensor(terms.uv).view(-1, 3, 2) - K[2:]) / K[:2]
        self.rays = rays[self.block_order][self.block].permute(1, 2, 0).contiguous()
        start = _tensor(terms.inverse_depth).view(-1, 3)[self.block_order].mT
        self.x = start.clamp_min(INVERSE_DEPTH_MIN).contiguous()
        self.prior = _tensor(terms.prior).view(-1, 3)[self.block_order].mT.contiguous()
        self.information = _tensor(terms.prior_information).view(-1, 3, 3)[self.block_order]
        order = self.pair_order
        self.uv = _tensor(terms.pair_uv).view(-1, 2)[order].mT.contiguous()
        self.arms = _tensor(terms.pair_arms).view(-1, 2, 2)[order].permute(1, 2, 0).contiguous()
        angles = 1 if terms.cosines else 2
        weights = [terms.inv_sigma_px] * 2 + [terms.inv_sigma_angle] * angles
        self.weight = torch.tensor(weights, dtype=torch.float64)[:, None]

    def _given(self) -> tuple[Tensor | bool | Kernel | float, ...]:
        return (self.rays, self.uv, self.arms, self.weight, self.K, self.cosines, *self._kernel())

    def weigh(self, Rt: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See `RelativeBlocks.weigh`."""
        out: tuple[Tensor, Tensor, Tensor, Tensor] = kernel(junction_weights, self.config.compile)(
            Rt, x, *self._given()
        )
        return out

    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """See `RelativeBlocks.robust_cost`."""
        out: Tensor = kernel(junction_cost, self.config.compile)(Rt, x, *self._given())
        return out

    def prior_cost(self, x: Tensor) -> Tensor:
        """See `RelativeBlocks.prior_cost`."""
        e = (x - self.prior).mT
        return torch.einsum("ci,cij,cj->", e, self.information, e)

    def add_prior(self, x: Tensor, V: Tensor, g: Tensor) -> None:
        """See `RelativeBlocks.add_prior`."""
        e = (x - self.prior).mT
        for row, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
            V[row] += self.information[:, i, j]
        g += torch.einsum("cij,cj->ic", self.information, e)


def collinearity_prior(
    fraction: FloatArray, inverse_depth: FloatArray, sigma: FloatArray, weak_sigma: float = 10.0
) -> tuple[FloatArray, FloatArray]:
    """Straight arms through the depths of their edge points: prior of a `JunctionTerms`, paper eq. (26).

    A straight line in space has inverse depths that are linear along its image, so the arm is a line fitted to the
    inverse depths of its points; their scatter about it is the collinearity residual.

    Args:
        fraction: Position of each point along its arm ``(C, 2, M)``, 0 at the corner and 1 at the arm's end; NaN
            for no point.
        inverse_depth: Their inverse depths ``(C, 2, M)`` [1/m].
        sigma: Their standard deviations ``(C, 2, M)`` [1/m].
        weak_sigma: Keeps a junction without points solvable [1/m].

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


def _put(J: Tensor, Jd: Tensor, weight: Tensor, r: Tensor, by_pose: Tensor, by_depth: Tensor) -> None:
    """Weighted rows into their places: ``J (R, 7, P)``, ``Jd (R, 1, P)``; a single row comes without its axis."""
    torch.mul(by_pose, weight, out=J[:, :6] if by_pose.ndim == 3 else J[0, :6])
    torch.mul(r, weight, out=J[:, 6] if r.ndim == 2 else J[0, 6])
    torch.mul(by_depth, weight, out=Jd[:, 0] if by_depth.ndim == 2 else Jd[0, 0])


def _tensor(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.float64))
