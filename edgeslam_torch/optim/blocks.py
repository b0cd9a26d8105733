"""Landmark blocks in the solver's memory layout: anchors, and edge pixels and junctions owned by a host pose.

Each kind turns a state into `Normal` equations. Derivatives of hosted blocks are by the relative pose of host and
target; the adjoint transforms them to the two poses: ``xi_relative = xi_target - Ad(T_target_host) xi_host``.
"""

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.robust_statistics import CHI2_1DOF_95, CHI2_2DOF_95
from edgeslam_torch.optim.kernels import edges as edge_kernel
from edgeslam_torch.optim.kernels.normal_equations import accumulate, coupled
from edgeslam_torch.optim.kernels.reprojection import stepped
from edgeslam_torch.optim.problem import DepthPriors, EdgeTerms, JunctionTerms, LmConfig, Rows, WindowProblem
from edgeslam_torch.types import FloatArray, IntArray

Value = TypeVar("Value", bound=np.generic)
INVERSE_DEPTH_MIN = 1e-4
"""Lower bound of refined inverse depths: practically at infinity, never behind the camera [1/map unit]."""
POINT_DELTA, LINE_DELTA = CHI2_2DOF_95**0.5, CHI2_1DOF_95**0.5
"""Thresholds of Huber's kernel [standard deviations] of pixels, and of the rows of edges and junctions, scalars."""
_NO_PRIORS = DepthPriors(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations of the blocks of one kind at a state, and their residuals."""

    V: FloatArray
    """``(B, m, m)``."""
    g: FloatArray
    """``(B, m)``."""
    W: FloatArray
    """``(S, m, 6)`` couplings with poses, see `Links`."""
    cost: float
    by_block: tuple[FloatArray, NDArray[np.bool_]]
    """Whitened residuals ``(n, k)``, without depth priors, and which lie in front of the camera ``(n,)``; sorted by
    block."""
    order: IntArray
    """``(n,)`` number of each in the caller's order."""

    @property
    def r(self) -> FloatArray:
        """Whitened residuals in the caller's order ``(n, k)``."""
        return _unsorted(self.by_block[0], self.order)

    @property
    def front(self) -> NDArray[np.bool_]:
        """Which lie in front of the camera, in the caller's order ``(n,)``."""
        return _unsorted(self.by_block[1], self.order)


@dataclass(frozen=True, slots=True)
class Links:
    """Couplings between free poses and blocks, sorted by block."""

    start: IntArray
    """``(B + 1,)`` first row of each block."""
    column: IntArray
    """``(S,)`` free pose of each row, ascending within a block."""


class Blocks(Protocol):
    """Blocks of one kind."""

    x: FloatArray
    """``(B, m)`` initial values."""
    links: Links

    def normal(self, T_c_w: FloatArray, x: FloatArray, H: FloatArray, g: FloatArray) -> Normal:
        """Normal equations at poses and blocks; the poses' part is added to ``H (6 F, 6 F)`` and ``g (6 F,)``."""

    def moved(self, T_c_w: FloatArray, x: FloatArray, step: FloatArray) -> FloatArray:
        """The blocks after a step, both ``(B, m)``, from poses ``(W, 4, 4)``."""


class Anchors:
    """Points in the world: reprojections and depth priors."""

    def __init__(self, problem: WindowProblem, column: IntArray, config: LmConfig, rows: Rows) -> None:
        """Lay out; ``column (W,)`` is the free-pose number of each pose, -1 for a fixed one."""
        self.config, self.rows, self.K = config, rows, tuple(float(k) for k in problem.K)
        self.free = int((column >= 0).sum())
        self.x: FloatArray = np.array(problem.p_w, dtype=np.float64).reshape(-1, 3)
        known = problem.depth_priors or _NO_PRIORS
        self.order = np.argsort(problem.obs_anchor, kind="stable")
        self.seen = _Seen(problem.obs_pose, problem.obs_anchor, problem.inv_sigma, column, self.order)
        self.known = _Seen(known.pose, known.anchor, 1.0 / np.asarray(known.sigma), column, slice(None))
        self.uv = _floats(problem.uv).reshape(-1, 2)[self.order]
        self.prior = _floats(known.inverse_depth)
        self.host = np.zeros(len(self.x), dtype=np.int64)
        self.host[self.seen.anchor[::-1]] = self.seen.pose[::-1]
        self.links, slots = linked(
            np.concatenate((self.seen.anchor, self.known.anchor)),
            np.concatenate((self.seen.column, self.known.column)),
            len(self.x),
            self.free,
        )
        self.slots = np.split(slots, [len(self.seen.pose)])

    def normal(self, T_c_w: FloatArray, x: FloatArray, H: FloatArray, g: FloatArray) -> Normal:
        """See `Blocks`."""
        config, seen, known = self.config, self.seen, self.known
        delta = POINT_DELTA if config.robust else math.inf
        V, g_x, W = np.zeros((len(x), 3, 3)), np.zeros(x.shape), np.zeros((len(self.links.column), 3, 6))
        own = np.zeros((self.free, 6, 6))
        to = (V, g_x, own, g.reshape(-1, 6), W)
        r, J, front = self.rows.reprojection(T_c_w, x, seen.pose, seen.anchor, self.uv, seen.inv_sigma, self.K)
        far = np.square(config.behind_px * seen.inv_sigma)
        cost = accumulate(r, J, front, far, True, delta, seen.anchor, seen.column, self.slots[0], *to)
        if len(known.pose):
            r_known, J, f = self.rows.inverse_depth(T_c_w, x, known.pose, known.anchor, self.prior, known.inv_sigma)
            far = np.square(config.behind_px * known.inv_sigma)
            cost += accumulate(r_known, J, f, far, True, delta, known.anchor, known.column, self.slots[1], *to)
        poses = np.arange(self.free)
        add_blocks(H, poses, poses, own)
        return Normal(V, g_x, W, cost, (r, front), self.order)

    def moved(self, T_c_w: FloatArray, x: FloatArray, step: FloatArray) -> FloatArray:
        """See `Blocks`."""
        return stepped(T_c_w, x, self.host, step)


class _Seen:
    """Observations, or priors, of anchors."""

    def __init__(
        self, pose: IntArray, anchor: IntArray, inv_sigma: FloatArray, column: IntArray, order: IntArray | slice
    ) -> None:
        self.pose, self.anchor = _indices(pose)[order], _indices(anchor)[order]
        self.inv_sigma = _floats(inv_sigma)[order]
        self.column = column[self.pose]


class Hosted:
    """Blocks of inverse depths in a host pose, with one robust weight per row: edges and junctions."""

    def __init__(
        self,
        host: IntArray,
        pair_block: IntArray,
        pair_pose: IntArray,
        inverse_depth: FloatArray,
        prior: tuple[FloatArray, FloatArray],
        column: IntArray,
        config: LmConfig,
    ) -> None:
        """Lay out.

        Args:
            host: ``(B,)`` host poses.
            pair_block: ``(P,)`` block of each pair.
            pair_pose: ``(P,)`` its target.
            inverse_depth: ``(B, m)`` start.
            prior: Expected inverse depths ``(B, m)`` and their information ``(B, m, m)``.
            column: ``(W,)`` free-pose number of each pose, -1 for a fixed one.
            config: Width of the robust kernel.

        Raises:
            ValueError: If a pair's target is its host.
        """
        self.config = config
        self.x: FloatArray = np.maximum(_floats(inverse_depth), INVERSE_DEPTH_MIN)
        self.prior, self.information = (_floats(p) for p in prior)
        host, pose = _indices(host), _indices(pair_pose)
        self.order = np.argsort(pair_block, kind="stable")
        self.block, pose = _indices(pair_block)[self.order], pose[self.order]
        if (host[self.block] == pose).any():
            raise ValueError("a pair's target pose must differ from its host")
        both, self.view = np.unique(host[self.block] * len(column) + pose, return_inverse=True)
        self.hosts, self.targets = both // len(column), both % len(column)
        self.columns = column[self.hosts], column[self.targets]
        self.links, slots = linked(
            np.concatenate((self.block, np.arange(len(host)))),
            np.concatenate((column[pose], column[host])),
            len(host),
            int((column >= 0).sum()),
        )
        self.target_slot, self.host_slot = np.split(slots, [len(pose)])
        self.pairs = np.arange(len(pose))
        self.far = np.full(len(pose), config.behind_px**2)

    def residuals(self, T_j_i: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Residuals of the pairs ``(P, k)``, derivatives ``(P, k, 6 + m)`` and which lie in front ``(P,)``."""
        raise NotImplementedError

    def normal(self, T_c_w: FloatArray, x: FloatArray, H: FloatArray, g: FloatArray) -> Normal:
        """See `Blocks`."""
        T_j_i = T_c_w[self.targets] @ se3.inverse(T_c_w[self.hosts])
        r, J, front = self.residuals(T_j_i, x)
        off = x - self.prior
        g_x = (self.information @ off[:, :, None])[:, :, 0]
        cost = float((off * g_x).sum())
        V = self.information.copy()
        pairs, views, m = len(self.pairs), len(T_j_i), x.shape[1]
        relative, own, g_view = np.zeros((pairs, m, 6)), np.zeros((views, 6, 6)), np.zeros((views, 6))
        to = (V, g_x, own, g_view, relative)
        delta = LINE_DELTA if self.config.robust else math.inf
        cost += accumulate(r, J, front, self.far, False, delta, self.block, self.view, self.pairs, *to)
        Ad = se3.adjoint(T_j_i)
        W = np.zeros((len(self.links.column), m, 6))
        coupled(relative, Ad, self.block, self.view, self.target_slot, self.host_slot, W)
        host, target = self.columns
        mixed = own @ Ad
        add_blocks(H, target, target, own)
        add_blocks(H, target, host, -mixed)
        add_blocks(H, host, target, -np.swapaxes(mixed, 1, 2))
        add_blocks(H, host, host, np.swapaxes(Ad, 1, 2) @ mixed)
        g = g.reshape(-1, 6)
        np.add.at(g, target[target >= 0], g_view[target >= 0])
        np.add.at(g, host[host >= 0], -(g_view[:, None] @ Ad)[host >= 0, 0])
        return Normal(V, g_x, W, cost, (r, front), self.order)

    def moved(self, T_c_w: FloatArray, x: FloatArray, step: FloatArray) -> FloatArray:
        """See `Blocks`."""
        return np.maximum(x + step, INVERSE_DEPTH_MIN)


class Edges(Hosted):
    """Edge pixels: alignment across the edge and the depth cycle, one inverse depth each."""

    def __init__(
        self, problem: WindowProblem, terms: EdgeTerms, column: IntArray, config: LmConfig, rows: Rows
    ) -> None:
        """Lay out."""
        sigma = _floats(terms.prior_sigma)
        known = np.isfinite(sigma)
        prior = np.where(known, terms.prior, 0.0)[:, None], np.where(known, sigma, np.inf)[:, None, None] ** -2.0
        start = _floats(terms.inverse_depth)[:, None]
        super().__init__(terms.host, terms.pair_edge, terms.pair_pose, start, prior, column, config)
        self.rows, self.K = rows, tuple(float(k) for k in problem.K)
        self.uv = _floats(terms.uv).reshape(-1, 2)
        self.uv_j, self.normal_j = (_floats(x).reshape(-1, 2)[self.order] for x in (terms.pair_uv, terms.pair_normal))
        self.inv_sigma = _floats(terms.pair_inv_sigma)[self.order]
        self.target_inverse_depth = _floats(terms.pair_inverse_depth)[self.order]
        has_cycle = terms.cycle_sigma > 0 and bool((self.target_inverse_depth > 0).any())
        form = edge_kernel.PIXEL if terms.cycle_px else edge_kernel.RELATIVE_DEPTH
        self.cycle = (form, 1.0 / terms.cycle_sigma) if has_cycle else (edge_kernel.NONE, 0.0)

    def residuals(self, T_j_i: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """See `Hosted`."""
        partner = self.uv_j, self.normal_j, self.inv_sigma, self.target_inverse_depth
        depth = np.ascontiguousarray(x[:, 0])
        return self.rows.edges(T_j_i, self.view, self.block, self.uv, depth, *partner, *self.cycle, self.K)


class Junctions(Hosted):
    """L-junctions: corner, arms or angle, and the straightness of the arms, three inverse depths each."""

    def __init__(
        self, problem: WindowProblem, terms: JunctionTerms, column: IntArray, config: LmConfig, rows: Rows
    ) -> None:
        """Lay out."""
        start, prior = (_floats(x).reshape(-1, 3) for x in (terms.inverse_depth, terms.prior))
        known = prior, _floats(terms.prior_information).reshape(-1, 3, 3)
        super().__init__(terms.host, terms.pair_junction, terms.pair_pose, start, known, column, config)
        self.rows, self.K = rows, tuple(float(k) for k in problem.K)
        self.uv = _floats(terms.uv).reshape(-1, 3, 2)
        self.uv_j = _floats(terms.pair_uv).reshape(-1, 2)[self.order]
        self.arms_j = _floats(terms.pair_arms).reshape(-1, 2, 2)[self.order]
        self.form = float(terms.inv_sigma_px), float(terms.inv_sigma_angle), bool(terms.cosines)

    def residuals(self, T_j_i: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """See `Hosted`."""
        return self.rows.junctions(T_j_i, self.view, self.block, self.uv, x, self.uv_j, self.arms_j, *self.form, self.K)


def linked(block: IntArray, column: IntArray, blocks: int, free: int) -> tuple[Links, IntArray]:
    """Rows of couplings: one for each pair of a block and a free pose that sees it.

    Args:
        block: ``(n,)`` blocks.
        column: ``(n,)`` poses that see them, -1 for a fixed one.
        blocks: Number of blocks.
        free: Number of free poses.

    Returns:
        The rows, and the row of each of the ``n`` entries, -1 for a fixed pose.
    """
    moves = column >= 0
    key, row = np.unique(block[moves] * max(free, 1) + column[moves], return_inverse=True)
    slot = np.full(len(block), -1, dtype=np.int64)
    slot[moves] = row
    start = np.searchsorted(key, np.arange(blocks + 1) * max(free, 1))
    return Links(start, key % max(free, 1)), slot


def add_blocks(H: FloatArray, row: IntArray, column: IntArray, blocks: FloatArray) -> None:
    """Add ``(n, 6, 6)`` to the poses' matrix ``(6 F, 6 F)`` at free poses ``(n,)``; fixed ones are -1."""
    F, free = len(H) // 6, (row >= 0) & (column >= 0)
    np.add.at(H.reshape(F, 6, F, 6).transpose(0, 2, 1, 3), (row[free], column[free]), blocks[free])


def _unsorted(values: NDArray[Value], order: IntArray) -> NDArray[Value]:
    out = np.empty_like(values)
    out[order] = values
    return out


def _floats(x: FloatArray) -> FloatArray:
    return np.ascontiguousarray(x, dtype=np.float64)


def _indices(x: IntArray) -> IntArray:
    return np.ascontiguousarray(x, dtype=np.int64)
