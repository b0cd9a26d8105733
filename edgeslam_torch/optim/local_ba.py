"""Sliding-window refinement of poses and anchors, paper eq. (28) and its thread 4."""

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
from edgeslam_torch.optim import lie, schur
from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.priors import PriorTerms
from edgeslam_torch.optim.problem import (
    DepthPriors,
    LmConfig,
    PosePrior,
    ScalePrior,
    StopReason,
    WindowProblem,
    WindowResult,
)
from edgeslam_torch.optim.robust import rho
from edgeslam_torch.types import FloatArray, IntArray

__all__ = [
    "DepthPriors",
    "LmConfig",
    "PosePrior",
    "ScalePrior",
    "StopReason",
    "WindowProblem",
    "WindowResult",
    "refine_window",
]


def refine_window(problem: WindowProblem, config: LmConfig | None = None) -> WindowResult:
    """Refine the free poses and all anchors of a window.

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
    if len(problem.obs_pose) == 0:
        return _unchanged(problem, StopReason.NO_OBSERVATIONS)
    with torch.inference_mode():
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
        # Anchors by the first free pose that sees them: chunks then span few poses.
        first_seen = torch.full((A,), F).scatter_reduce_(0, anchor, column[pose], "amin")
        self.anchor_order = torch.argsort(first_seen, stable=True)
        rank = torch.empty_like(self.anchor_order)
        rank[self.anchor_order] = torch.arange(A)
        # Factors by chunk, pose, anchor: blocks of a pose are slices and writes run forward through memory.
        # Those of fixed poses come last and need no derivatives of their own.
        key = torch.where(column[pose] < F, schur.chunk_of(rank[anchor], F), A) * (F + 1) + column[pose]
        self.order = torch.argsort(key * A + rank[anchor])
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
        p_w = _values(problem.p_w)[self.anchor_order]
        self.chunks = schur.plan_chunks(obs_column[: self.n_free], self.anchor[: self.n_free], A, F)
        self.Y = [torch.zeros(len(c.columns), 3 * (c.last - c.first), dtype=torch.float64) for c in self.chunks]
        column[fixed] = -1
        self.priors = PriorTerms(problem.pose_priors, problem.scale_priors, column.tolist())
        self.state = _State(T, p_w)

    # -- LeastSquares ---------------------------------------------------------------------------------------

    def cost(self, state: _State) -> float:
        """Robust cost of a candidate."""
        s, _ = self._chi2(state)
        value, _ = rho(s, self.config.kernel, self.config.delta)
        return float(value.sum()) + self.priors.cost(state.T_c_w)

    def accept(self, state: _State) -> None:
        """Make the candidate the current state."""
        self.state = state

    def linearise(self) -> tuple[float, float]:
        """Blocks of the normal equations at the current state."""
        T, p_w, F, A = self.state.T_c_w, self.state.p_w, len(self.free), len(self.state.p_w)
        n = self.n_free
        r, Jp, Jl, z = reprojection_jacobians(T, p_w, self.pose, self.anchor, self.uv, self.K)
        if len(self.depth_rows):
            rows = self.depth_rows
            R, p_c = camera_points(T, p_w, self.pose[rows], self.anchor[rows])
            r[1, rows], Jp[1][:, rows], Jl[1][:, rows] = 0.0, 0.0, 0.0
            iz, Jp[0][:, rows], Jl[0][:, rows] = inverse_depth_jacobians(R, p_c)
            r[0, rows] = iz - self.inverse_depth
        in_front = z > self.config.min_depth
        s = torch.where(in_front, (r * r).sum(0) * self.inv_sigma.square(), self.behind)
        value, weight = rho(s, self.config.kernel, self.config.delta)
        root = torch.where(in_front, weight.sqrt() * self.inv_sigma, 0.0)
        r, Jp, Jl = r.mul_(root), Jp[..., :n].mul_(root[:n]), Jl.mul_(root)
        if not bool(in_front.all()):  # 0 * inf where a point sits on the camera plane
            r, Jp, Jl = r.nan_to_num_(0, 0, 0), Jp.nan_to_num_(0, 0, 0), Jl.nan_to_num_(0, 0, 0)
        self.Jp, self.Jl = Jp, Jl
        self.H = torch.zeros(6 * F, 6 * F, dtype=T.dtype)
        self.g = torch.zeros(6 * F, dtype=T.dtype)
        rf = r[:, :n]
        g_pose = torch.addcmul(Jp[0] * rf[0], Jp[1], rf[1])
        for chunk in self.chunks:
            for pose, lo, hi in chunk.slices:
                block = Jp[:, :, lo:hi]
                at = slice(6 * pose, 6 * pose + 6)
                self.H[at, at] += (block @ block.mT).sum(0)
                self.g[at] += g_pose[:, lo:hi].sum(1)
        products = torch.empty(9, r.shape[1], dtype=T.dtype)
        for row, (i, j) in enumerate(_UPPER):
            torch.addcmul(Jl[0, i] * Jl[0, j], Jl[1, i], Jl[1, j], out=products[row])
        torch.addcmul(Jl[0] * r[0], Jl[1], r[1], out=products[6:])
        sums = torch.zeros(9, A, dtype=T.dtype)
        sums.index_add_(1, self.anchor, products)
        prior_cost = self.priors.linearise(T, self.H, self.g)
        self.V, self.g_point = sums[:6], sums[6:]
        return float(value.sum()) + prior_cost, self._scaled_gradient()

    def propose(self, mu: float) -> Step[_State] | None:
        """Solve the damped system by eliminating the anchors."""
        S, b, factor = self._reduce(mu)
        diagonal = self.H.diagonal()
        S.diagonal().add_(mu * diagonal + _PIVOT_FLOOR)
        L, info = torch.linalg.cholesky_ex(S)
        if int(info) != 0:
            return None
        delta = -torch.cholesky_solve(b[:, None], L)[:, 0]
        y = schur.whiten(factor, self.g_point)
        back = -y
        for chunk, Yc in zip(self.chunks, self.Y, strict=True):
            back[:, chunk.first : chunk.last] -= (delta[chunk.columns] @ Yc).view(3, -1)
        step = schur.unwhiten(factor, back)
        damped = (diagonal * delta * delta).sum() + (self.V[_DIAGONAL] * step * step).sum()
        predicted = float(mu * damped - self.g @ delta - (self.g_point * step).sum())
        size = float(torch.maximum(_abs_max(delta), _abs_max(step)))
        T = self.state.T_c_w.clone()
        T[self.free] = lie.exp(delta.view(-1, 6)) @ T[self.free]
        return Step(_State(T, self.state.p_w + step.mT), predicted, size)

    # -- the rest -------------------------------------------------------------------------------------------

    def refine(self) -> WindowResult:
        """Run the loop and report."""
        summary = minimise(self, self.config)
        s, in_front = self._chi2(self.state)
        M = self.n_obs
        chi2, front = torch.empty_like(s), torch.empty_like(in_front)
        chi2[self.order] = torch.where(in_front, s, torch.inf)
        front[self.order] = in_front
        p_w = torch.empty_like(self.state.p_w)
        p_w[self.anchor_order] = self.state.p_w
        stop = summary.stop
        if not bool(in_front.any()):
            stop = StopReason.NO_OBSERVATIONS
        deficiency, covariance = -1, torch.full((6, 6), torch.nan)
        if self.config.diagnostics and stop is not StopReason.NOT_FINITE and len(self.free):
            deficiency, covariance = self._diagnose()
        return WindowResult(
            T_c_w=self.state.T_c_w.numpy(),
            p_w=p_w.numpy(),
            chi2=chi2[:M].numpy(),
            in_front=front[:M].numpy(),
            cost_before=summary.cost_before,
            cost_after=summary.cost_after,
            iterations=summary.iterations,
            accepted=summary.accepted,
            stop=stop,
            rank_deficiency=deficiency,
            pose_covariance=covariance.numpy(),
        )

    def _chi2(self, state: _State) -> tuple[Tensor, Tensor]:
        r, z = reprojection_residuals(state.T_c_w, state.p_w, self.pose, self.anchor, self.uv, self.K)
        if len(self.depth_rows):
            r[1, self.depth_rows] = 0.0
            r[0, self.depth_rows] = z[self.depth_rows].reciprocal() - self.inverse_depth
        in_front = z > self.config.min_depth
        return torch.where(in_front, (r * r).sum(0) * self.inv_sigma.square(), self.behind), in_front

    def _scaled_gradient(self) -> float:
        pose = self.g / (self.H.diagonal() + _PIVOT_FLOOR).sqrt()
        point = self.g_point / (self.V[_DIAGONAL] + _PIVOT_FLOOR).sqrt()
        return float(torch.maximum(_abs_max(pose), _abs_max(point)))

    def _reduce(self, mu: float) -> tuple[Tensor, Tensor, Tensor]:
        """Pose system without the anchors, its right side and the anchors' factors; fills ``Y``."""
        factor, _ = schur.inverse_cholesky(self.V, mu)
        y = schur.whiten(factor, self.g_point)
        n = self.n_free
        a, b_, c, d, e, f = factor.index_select(1, self.anchor[:n])
        J = self.Jl[..., :n]
        white = torch.stack((a * J[:, 0], b_ * J[:, 0] + c * J[:, 1], d * J[:, 0] + e * J[:, 1] + f * J[:, 2]))
        blocks = torch.addcmul(self.Jp[0][:, None] * white[:, 0], self.Jp[1][:, None], white[:, 1])  # (6, 3, n)
        blocks = blocks.view(18, -1)
        S, b = self.H.clone(), self.g.clone()
        for chunk, Yc in zip(self.chunks, self.Y, strict=True):
            part = blocks[:, chunk.lo : chunk.hi].flatten()
            if chunk.unique:
                Yc.view(-1).index_copy_(0, chunk.flat, part)
            else:
                Yc.zero_().view(-1).index_add_(0, chunk.flat, part)
            S[chunk.columns[:, None], chunk.columns] -= Yc @ Yc.mT
            b[chunk.columns] -= Yc @ y[:, chunk.first : chunk.last].flatten()
        return S, b, factor

    def _diagnose(self) -> tuple[int, Tensor]:
        """Unobservable directions of the undamped pose system and the last free pose's covariance."""
        self.linearise()
        S = self._reduce(0.0)[0]
        scale = (self.H.diagonal() + _PIVOT_FLOOR).rsqrt()
        values, vectors = torch.linalg.eigh(scale[:, None] * S * scale)
        good = values > self.config.rank_tolerance * values[-1].clamp_min(_PIVOT_FLOOR)
        rows = vectors[-6:, good]
        covariance = (rows / values[good]) @ rows.mT * scale[-6:, None] * scale[-6:]
        return int((~good).sum()), covariance


def _index(*parts: IntArray) -> Tensor:
    return torch.as_tensor(np.concatenate([np.asarray(x, dtype=np.int64) for x in parts]))


def _values(x: FloatArray) -> Tensor:
    return torch.as_tensor(np.asarray(x, dtype=np.float64))


_NO_DEPTH_PRIORS = DepthPriors(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_DIAGONAL = [0, 3, 5]
_PIVOT_FLOOR = 1e-30


def _abs_max(x: Tensor) -> Tensor:
    return x.abs().max() if x.numel() else x.new_zeros(())
