"""Sliding-window refinement of poses and anchors, paper eq. (28) and its thread 4."""

import math
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.reprojection import (
    camera_points,
    inverse_depth_jacobians,
    reprojection_jacobians,
    reprojection_residuals,
)
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim import lie, schur
from edgeslam_torch.optim.compiled import kernel
from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.priors import PriorTerms
from edgeslam_torch.optim.problem import (
    DepthPriors,
    EdgeTerms,
    JunctionTerms,
    LmConfig,
    PosePrior,
    ScalePrior,
    StopReason,
    WindowProblem,
    WindowResult,
)
from edgeslam_torch.optim.relative import INVERSE_DEPTH_MIN, EdgeBlocks, JunctionBlocks
from edgeslam_torch.types import FloatArray, IntArray

__all__ = [
    "DepthPriors",
    "EdgeTerms",
    "JunctionTerms",
    "LmConfig",
    "PosePrior",
    "ScalePrior",
    "StopReason",
    "WindowProblem",
    "WindowResult",
    "refine_window",
]


def refine_window(problem: WindowProblem, config: LmConfig | None = None) -> WindowResult:
    """Refine the free poses of a window with its anchors, edge depths and junctions.

    Args:
        problem: Poses, anchors, observations and what is known beforehand.
        config: How to minimise.

    Returns:
        The refined window. Whatever the input, poses and points are finite if they were finite on entry, and
        ``stop`` says why the solver ended.

    Raises:
        ValueError: If array lengths disagree or an index points outside.
    """
    config = config or LmConfig()
    _check(problem)
    finite = all(
        bool(np.isfinite(x).all()) for x in (problem.T_c_w, problem.p_w, problem.uv, problem.inv_sigma, problem.K)
    )
    if not finite:
        return _unchanged(problem, StopReason.NOT_FINITE)
    if len(problem.obs_pose) == 0 and problem.edges is None and problem.junctions is None:
        return _unchanged(problem, StopReason.NO_OBSERVATIONS)
    # As a context, a default device costs microseconds per torch call: not for the CPU, which is the default.
    device = nullcontext() if config.device == "cpu" else torch.device(config.device)
    with torch.inference_mode(), device:
        return _Window(problem, config).refine()


def _check(problem: WindowProblem) -> None:
    W, A, M = len(problem.T_c_w), len(problem.p_w), len(problem.obs_pose)
    lengths = {len(problem.obs_anchor), len(problem.uv), len(problem.inv_sigma), M}
    if len(lengths) != 1:
        raise ValueError(f"obs_pose, obs_anchor, uv and inv_sigma must be equally long, got {sorted(lengths)}")
    if len(problem.pose_fixed) != W:
        raise ValueError(f"pose_fixed must have {W} entries, got {len(problem.pose_fixed)}")
    for name, index, limit in (("obs_pose", problem.obs_pose, W), ("obs_anchor", problem.obs_anchor, A)):
        if M and (np.min(index) < 0 or np.max(index) >= limit):
            raise ValueError(f"{name} must lie in [0, {limit}), got {np.min(index)}..{np.max(index)}")


def _unchanged(problem: WindowProblem, stop: StopReason) -> WindowResult:
    M = len(problem.obs_pose)
    return WindowResult(
        T_c_w=np.array(problem.T_c_w, dtype=np.float64),
        p_w=np.array(problem.p_w, dtype=np.float64),
        chi2=np.full(M, np.inf),
        in_front=np.zeros(M, dtype=bool),
        cost_before=np.nan,
        cost_after=np.nan,
        iterations=0,
        accepted=0,
        stop=stop,
        rank_deficiency=-1,
    )


@dataclass(frozen=True, slots=True)
class _State:
    T_c_w: Tensor
    p_w: Tensor
    """Anchors in the solver's order."""
    relative: tuple[Tensor, ...]
    """Inverse depths of edges and junctions in their tiles ``(size, B, L)``."""


class _Window:
    """State and linear system of one refinement; implements `LeastSquares`.

    Reprojections and depth priors are one list of factors with two residual rows each (a depth prior's second
    row is zero), so that every step below handles both.
    """

    def __init__(self, problem: WindowProblem, config: LmConfig) -> None:
        self.config = config
        depth = problem.depth_priors or _NO_DEPTH_PRIORS
        M, D, A = len(problem.obs_pose), len(depth.anchor), len(problem.p_w)
        T = torch.tensor(np.asarray(problem.T_c_w), dtype=torch.float64)
        fixed = torch.as_tensor(np.asarray(problem.pose_fixed, dtype=bool))
        pose = _index(problem.obs_pose, depth.pose)
        anchor = _index(problem.obs_anchor, depth.anchor)
        self.free = torch.nonzero(~fixed)[:, 0]
        F = len(self.free)
        column = torch.full((len(T),), F, dtype=torch.int64)
        column[self.free] = torch.arange(F)
        # Anchors by the first and last free pose that sees them: chunks then span few poses.
        first = torch.full((A,), F).scatter_reduce_(0, anchor, column[pose], "amin")
        last = torch.full((A,), -1).scatter_reduce_(0, anchor, torch.where(column < F, column, -1)[pose], "amax")
        self.anchor_order = torch.argsort(first * (F + 1) + last, stable=True)
        rank = torch.empty_like(self.anchor_order)
        rank[self.anchor_order] = torch.arange(A)
        # Factors by chunk, pose, anchor: blocks of a pose are slices and writes run forward through memory.
        # Those of fixed poses come last and need no derivatives of their own.
        size = A if F <= _FEW_POSES else _ANCHORS_PER_CHUNK
        chunk = torch.where(column[pose] < F, rank[anchor] // max(size, 1), A)
        self.order = torch.argsort((chunk * (F + 1) + column[pose]) * A + rank[anchor])
        self.pose, self.anchor = pose[self.order], rank[anchor[self.order]]
        obs_column = column[self.pose]
        self.n_free = int((obs_column < F).sum())
        self.n_obs = M
        self.depth_rows = torch.nonzero(self.order >= M)[:, 0]
        self.inverse_depth = _values(depth.inverse_depth)[self.order[self.depth_rows] - M]
        uv = torch.cat((_values(problem.uv).reshape(-1, 2), torch.zeros(D, 2, dtype=torch.float64)))
        self.uv = uv[self.order].mT.contiguous()
        self.inv_sigma = torch.cat((_values(problem.inv_sigma), 1.0 / _values(depth.sigma)))[self.order]
        self.behind = (config.behind_px * self.inv_sigma).square()
        self.K = torch.tensor(problem.K, dtype=torch.float64)
        p_w = _values(problem.p_w).reshape(-1, 3)[self.anchor_order]
        bounds = [*range(0, A, max(size, 1)), A]
        self.chunks = schur.plan_chunks(obs_column[: self.n_free], self.anchor[: self.n_free], bounds, 3)
        self.Y = [torch.zeros(len(c.columns), 3 * (c.last - c.first), dtype=torch.float64) for c in self.chunks]
        column[fixed] = -1
        self.priors = PriorTerms(problem.pose_priors, problem.scale_priors, column.tolist())
        self.relative: list[EdgeBlocks | JunctionBlocks] = []
        if problem.edges is not None and len(problem.edges.host):
            self.relative.append(EdgeBlocks(problem.edges, self.K, column, config))
        if problem.junctions is not None and len(problem.junctions.host):
            self.relative.append(JunctionBlocks(problem.junctions, self.K, column, config))
        self.state = _State(T, p_w, tuple(block.x for block in self.relative))
        self._seen: tuple[_State, Tensor, Tensor] | None = None

    # -- LeastSquares ---------------------------------------------------------------------------------------

    def cost(self, state: _State) -> float:
        """Robust cost of a candidate."""
        total = float(kernel(point_cost, self.config.compile)(*self._given(state)[1:])) + self.priors.cost(state.T_c_w)
        return total + sum(float(b.cost(state.T_c_w, x)) for b, x in self._blocks(state))

    def accept(self, state: _State) -> None:
        """Make the candidate the current state."""
        self.state = state

    def linearise(self) -> tuple[float, float]:
        """Blocks of the normal equations at the current state."""
        T, F, A = self.state.T_c_w, len(self.free), len(self.state.p_w)
        Jp, self.Jl, own, value = kernel(point_weights, self.config.compile)(*self._given(self.state), self.n_free)
        self.Jp = Jp[:, :6]
        normal = torch.zeros(F, 7, 7, dtype=T.dtype)
        for chunk in self.chunks:
            for pose, lo, hi in chunk.slices:
                for row in Jp[:, :, lo:hi]:
                    normal[pose].addmm_(row, row.mT)
        self.H = torch.zeros(F, 6, F, 6, dtype=T.dtype)
        each = torch.arange(F)
        self.H[each, :, each] = normal[:, :6, :6]
        self.H, self.g = self.H.view(6 * F, 6 * F), normal[:, :6, 6].flatten()
        sums = torch.zeros(9, A, dtype=T.dtype)
        sums.index_add_(1, self.anchor, own)
        self.V, self.g_point = sums[:6], sums[6:]
        cost = float(value) + self.priors.linearise(T, self.H, self.g)
        cost += sum(float(b.linearise(T, x, self.H, self.g)) for b, x in self._blocks(self.state))
        return cost, self._scaled_gradient()

    def propose(self, mu: float) -> Step[_State] | None:
        """Solve the damped system by eliminating anchors, edge depths and junctions."""
        S, b = self._reduce(mu)
        diagonal = self.H.diagonal()
        S.diagonal().add_(mu * diagonal + _FLOOR)
        L, info = torch.linalg.cholesky_ex(S)
        if int(info) != 0:
            return None
        delta = -torch.cholesky_solve(b[:, None], L)[:, 0]
        back = -self.y
        for chunk, Y in zip(self.chunks, self.Y, strict=True):
            back[:, chunk.first : chunk.last] -= (delta[chunk.columns] @ Y).view(3, -1)
        step = schur.unwhiten(self.factor, back)
        predicted = _promise(mu, diagonal, self.g, delta) + _promise(mu, self.V[_DIAGONAL], self.g_point, step)
        size = torch.maximum(_abs_max(delta), _abs_max(step))
        moved = []
        for block, x in self._blocks(self.state):
            dx = block.step(delta)
            predicted += _promise(mu, block.V[schur.diagonal_rows(block.size)], block.g, dx)
            size = torch.maximum(size, _abs_max(dx))
            moved.append((x + dx).clamp_min(INVERSE_DEPTH_MIN))
        T = self.state.T_c_w.clone()
        T[self.free] = kernel(lie.exp, self.config.compile)(delta.view(-1, 6)) @ T[self.free]
        return Step(_State(T, self.state.p_w + step.mT, tuple(moved)), predicted, float(size))

    # -- the rest -------------------------------------------------------------------------------------------

    def refine(self) -> WindowResult:
        """Run the loop and report."""
        summary = minimise(self, self.config)
        s, in_front = self._chi2(self.state)
        M = self.n_obs
        deficiency, covariance = -1, np.full((6, 6), np.nan)
        if self.config.diagnostics and summary.stop is not StopReason.NOT_FINITE and len(self.free):
            deficiency, covariance = self._diagnose()
        stop = summary.stop if bool(in_front.any()) or self.relative else StopReason.NO_OBSERVATIONS
        edges, junctions = {}, {}
        for block, x in self._blocks(self.state):
            if isinstance(block, EdgeBlocks):
                sigma = self._edge_sigma(block) if deficiency >= 0 else torch.full_like(x[0], torch.nan)
                edges = {
                    "edge_inverse_depth": block.tiles.of_blocks(x[0]),
                    "edge_sigma": block.tiles.of_blocks(sigma),
                    "edge_chi2": block.alignment_chi2(self.state.T_c_w, x),
                }
            else:
                junctions = {"junction_inverse_depth": block.tiles.of_blocks(x).T.copy()}
        return WindowResult(
            T_c_w=self.state.T_c_w.cpu().numpy(),
            p_w=_restored(self.state.p_w, self.anchor_order),
            chi2=_restored(torch.where(in_front, s, torch.inf), self.order)[:M],
            in_front=_restored(in_front, self.order)[:M],
            cost_before=summary.cost_before,
            cost_after=summary.cost_after,
            iterations=summary.iterations,
            accepted=summary.accepted,
            stop=stop,
            rank_deficiency=deficiency,
            pose_covariance=covariance,
            **edges,
            **junctions,
        )

    def _blocks(self, state: _State) -> list[tuple[EdgeBlocks | JunctionBlocks, Tensor]]:
        return list(zip(self.relative, state.relative, strict=True))

    def _camera_points(self, state: _State) -> tuple[Tensor, Tensor]:
        """`camera_points` of a state; an accepted candidate is asked for twice."""
        if self._seen is None or self._seen[0] is not state:
            see = kernel(camera_points, self.config.compile)
            self._seen = (state, *see(state.T_c_w, state.p_w, self.pose, self.anchor))
        return self._seen[1:]

    def _given(self, state: _State) -> tuple[Tensor | Kernel | float, ...]:
        """Arguments of `point_weights` at a state, without the last; without the first too, of `point_cost`."""
        R, p_c = self._camera_points(state)
        c = self.config
        data = (self.uv, self.K, self.inv_sigma, self.behind, self.depth_rows, self.inverse_depth)
        return R, p_c, *data, c.min_depth, c.kernel, c.delta

    def _chi2(self, state: _State) -> tuple[Tensor, Tensor]:
        _, p_c = self._camera_points(state)
        data = (self.uv, self.K, self.inv_sigma, self.behind, self.depth_rows, self.inverse_depth)
        return point_chi2(p_c, *data, self.config.min_depth)

    def _scaled_gradient(self) -> float:
        parts = [(self.g, self.H.diagonal()), (self.g_point, self.V[_DIAGONAL])]
        parts += [(b.g, b.V[schur.diagonal_rows(b.size)]) for b in self.relative]
        largest = [(g.square() / (h + _FLOOR)).max() for g, h in parts if g.numel()]
        return math.sqrt(max(float(x) for x in largest)) if largest else 0.0

    def _reduce(self, mu: float) -> tuple[Tensor, Tensor]:
        """Pose system without its anchors, edges and junctions, and its right side; fills the ``Y``."""
        self.factor = schur.inverse_cholesky(self.V, mu)
        self.y = schur.whiten(self.factor, self.g_point)
        fill = kernel(schur.fill, self.config.compile)
        S, b = self.H.clone(), self.g.clone()
        for chunk, Y in zip(self.chunks, self.Y, strict=True):
            part = slice(chunk.lo, chunk.hi)
            fill(Y, chunk.flat, chunk.unique, self.factor, self.anchor[part], self.Jp[..., part], self.Jl[..., part])
            S[chunk.columns[:, None], chunk.columns] -= Y @ Y.mT
            b[chunk.columns] -= Y @ self.y[:, chunk.first : chunk.last].flatten()
        for block in self.relative:
            block.reduce(mu, S, b)
        return S, b

    def _diagnose(self) -> tuple[int, FloatArray]:
        """Unobservable directions of the undamped pose system and the last free pose's covariance."""
        self.linearise()
        S, _ = self._reduce(0.0)
        scale = (self.H.diagonal() + _FLOOR).rsqrt()
        values, vectors = torch.linalg.eigh(scale[:, None] * S * scale)
        good = values > self.config.rank_tolerance * values[-1].clamp_min(_FLOOR)
        rows = vectors[-6:, good]
        covariance = (rows / values[good]) @ rows.mT * scale[-6:, None] * scale[-6:]
        return int((~good).sum()), covariance.cpu().numpy()

    @staticmethod
    def _edge_sigma(block: EdgeBlocks) -> Tensor:
        return block.V[0].rsqrt()


def point_chi2(
    p_c: Tensor,
    uv: Tensor,
    K: Tensor,
    inv_sigma: Tensor,
    behind: Tensor,
    depth_rows: Tensor,
    inverse_depth: Tensor,
    min_depth: float,
) -> tuple[Tensor, Tensor]:
    """Squared whitened residuals ``(M,)`` of reprojections and depth priors, and which points lie in front.

    Args:
        p_c: Points in the cameras that see them ``(3, M)``.
        uv: Observed pixels ``(2, M)``.
        K: fx, fy, cx, cy ``(4,)``.
        inv_sigma: ``(M,)``.
        behind: What stands for a point behind the camera ``(M,)``.
        depth_rows: ``(D,)`` factors that are depth priors.
        inverse_depth: ``(D,)`` their expected inverse depths.
        min_depth: Nearest depth in front of the camera.
    """
    in_front = p_c[2] > min_depth
    p_c = torch.where(in_front, p_c, 1.0)
    r = reprojection_residuals(p_c, uv, K)
    if len(depth_rows):
        r[1, depth_rows] = 0.0
        r[0, depth_rows] = p_c[2, depth_rows].reciprocal() - inverse_depth
    return torch.where(in_front, r.square().sum(0) * inv_sigma.square(), behind), in_front


def point_cost(
    p_c: Tensor,
    uv: Tensor,
    K: Tensor,
    inv_sigma: Tensor,
    behind: Tensor,
    depth_rows: Tensor,
    inverse_depth: Tensor,
    min_depth: float,
    robust: Kernel,
    delta: float,
) -> Tensor:
    """Robust cost ``()``; arguments as `point_chi2` takes them, then the kernel and its width."""
    s, _ = point_chi2(p_c, uv, K, inv_sigma, behind, depth_rows, inverse_depth, min_depth)
    return rho(s, robust, delta)[0].sum()


def point_weights(
    R: Tensor,
    p_c: Tensor,
    uv: Tensor,
    K: Tensor,
    inv_sigma: Tensor,
    behind: Tensor,
    depth_rows: Tensor,
    inverse_depth: Tensor,
    min_depth: float,
    robust: Kernel,
    delta: float,
    n: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whitened rows of reprojections and depth priors times the roots of their robust weights.

    Args as `point_cost` takes them, with the cameras' rotations ``(3, 3, M)`` before and, last, the number of factors
    whose pose is free: they come first.

    Returns:
        By the free poses with the residual as seventh ``(2, 7, n)``, by anchor ``(2, 3, M)``, the anchors' own
        normal matrices and gradients ``(9, M)``, and the cost ``()``.
    """
    in_front = p_c[2] > min_depth
    p_c = torch.where(in_front, p_c, 1.0)  # finite, and weighted by zero
    r, Jp, Jl = reprojection_jacobians(R, p_c, uv, K)
    if len(depth_rows):
        rows = depth_rows
        r[1, rows], Jp[1][:, rows], Jl[1][:, rows] = 0.0, 0.0, 0.0
        iz, Jp[0][:, rows], Jl[0][:, rows] = inverse_depth_jacobians(R[..., rows], p_c[:, rows])
        r[0, rows] = iz - inverse_depth
    s = torch.where(in_front, r.square().sum(0) * inv_sigma.square(), behind)
    value, weight = rho(s, robust, delta)
    root = torch.where(in_front, weight.sqrt() * inv_sigma, 0.0)
    r, Jl = r * root, Jl * root
    Jp = torch.cat((Jp[..., :n] * root[:n], r[:, None, :n]), 1)
    own = torch.stack((*schur.triangle(Jl), *(Jl * r[:, None]).sum(0)))
    return Jp, Jl, own, value.sum()


def _promise(mu: float, diagonal: Tensor, g: Tensor, step: Tensor) -> float:
    """Decrease of the cost that the linear model promises, ``step^T (mu D step - g)``."""
    return float((step * (mu * diagonal * step - g)).sum())


def _restored(x: Tensor, order: Tensor) -> np.ndarray:
    """``x`` from the solver's order to the caller's."""
    out = torch.empty_like(x)
    out[order] = x
    return out.cpu().numpy()


def _index(*parts: IntArray) -> Tensor:
    return torch.as_tensor(np.concatenate([np.asarray(x, dtype=np.int64) for x in parts]))


def _values(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.float64))


_FEW_POSES = 12
"""Up to this many free poses, cutting the anchors into chunks saves less than it costs."""
_ANCHORS_PER_CHUNK = 512
_NO_DEPTH_PRIORS = DepthPriors(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))
_DIAGONAL = schur.diagonal_rows(3)
_FLOOR = 1e-30


def _abs_max(x: Tensor) -> Tensor:
    return x.abs().max() if x.numel() else x.new_zeros(())
