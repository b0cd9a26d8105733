"""Sliding-window refinement of poses and anchors, paper eq. (28) and its thread 4."""

import math
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.optim.kernels import pair_blocks, point_blocks, schur
from edgeslam_torch.optim.kernels.compiled import kernel
from edgeslam_torch.optim.kernels.edge_blocks import EdgeBlocks
from edgeslam_torch.optim.kernels.junction_blocks import JunctionBlocks
from edgeslam_torch.optim.kernels.pair_blocks import INVERSE_DEPTH_MIN, RelativeSystem
from edgeslam_torch.optim.kernels.point_blocks import PointBlocks, PointSystem
from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.motion_factors import MotionTerms
from edgeslam_torch.optim.objective import refined, window_losses
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
from edgeslam_torch.types import FloatArray

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
        problem: Poses, anchors, observations and priors.
        config: How to minimise.

    Returns:
        The refined window. Whatever the input, poses and points are finite if they were finite on entry, and ``stop``
        is the reason for stopping.

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
    # A default-device context costs microseconds per torch call; skip it for the CPU.
    device = nullcontext() if config.device == "cpu" else torch.device(config.device)
    with torch.inference_mode(), device:
        result = _Window(problem, config).refine()
    return replace(result, losses=window_losses(refined(problem, result))) if config.losses else result


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
    p: Tensor
    """Anchors as `PointBlocks` keeps them ``(3, A)``."""
    relative: tuple[Tensor, ...]
    """Inverse depths of edges and junctions in their tiles ``(size, B, L)``."""


@dataclass(frozen=True, slots=True)
class _System:
    """Cost and normal equations at a state."""

    state: _State
    cost: float
    gradient: float
    H: Tensor
    """``(6F, 6F)`` of the free poses."""
    g: Tensor
    """``(6F,)``."""
    points: PointSystem
    relative: tuple[RelativeSystem, ...]


class _Window:
    """One refinement; implements `LeastSquares`."""

    def __init__(self, problem: WindowProblem, config: LmConfig) -> None:
        self.config = config
        fixed = np.asarray(problem.pose_fixed, dtype=bool)
        column = np.where(fixed, -1, np.cumsum(~fixed) - 1)
        self.free = torch.as_tensor(np.flatnonzero(~fixed))
        K = torch.tensor(problem.K, dtype=torch.float64)
        self.points = PointBlocks(problem, K, column, config)
        self.priors = PriorTerms(problem.pose_priors, problem.scale_priors, column.tolist(), problem.relative_priors)
        self.motion = MotionTerms(problem.centres, problem.gravity, problem.headings, column.tolist())
        self.relative: list[EdgeBlocks | JunctionBlocks] = []
        columns = torch.as_tensor(column)
        if problem.edges is not None and len(problem.edges.host):
            self.relative.append(EdgeBlocks(problem.edges, K, columns, config))
        if problem.junctions is not None and len(problem.junctions.host):
            self.relative.append(JunctionBlocks(problem.junctions, K, columns, config))
        T = torch.tensor(np.asarray(problem.T_c_w), dtype=torch.float64)
        self.start = _State(T, self.points.p, tuple(block.x for block in self.relative))

    # -- LeastSquares ---------------------------------------------------------------------------------------

    def cost(self, state: _State) -> float:
        """Robust cost of a state."""
        total = float(self.points.cost(state.T_c_w, state.p)) + self.priors.cost(state.T_c_w)
        total += self.motion.cost(state.T_c_w)
        return total + sum(float(b.cost(state.T_c_w, x)) for b, x in self._blocks(state))

    def linearise(self, state: _State) -> _System:
        """Cost and blocks of the normal equations at a state."""
        T, F = state.T_c_w, len(self.free)
        anchors = self.points.linearise(T, state.p)
        H = torch.zeros(F, 6, F, 6, dtype=T.dtype)
        H.diagonal(dim1=0, dim2=2).copy_(anchors.H.permute(1, 2, 0))
        H, g = H.view(6 * F, 6 * F), anchors.g.flatten()
        cost = float(anchors.cost) + self.priors.linearise(T, H, g)
        cost += self.motion.linearise(T, H, g)
        relative = []
        for block, x in self._blocks(state):
            system, value = block.linearise(T, x, H, g)
            relative.append(system)
            cost += float(value)
        gradient = _scaled_gradient(H, g, anchors.system, *relative)
        return _System(state, cost, gradient, H, g, anchors.system, tuple(relative))

    def propose(self, system: _System, mu: float) -> Step[_State] | None:
        """Solve the damped system by eliminating anchors, edge depths and junctions."""
        S, b, points, relative = self._reduce(system, mu)
        diagonal = system.H.diagonal()
        S.diagonal().add_(mu * diagonal + _FLOOR)
        L, info = torch.linalg.cholesky_ex(S)
        if int(info) != 0:
            return None
        delta = -torch.cholesky_solve(b[:, None], L)[:, 0]
        step = self.points.step(system.points, points, delta)
        predicted = _promise(mu, diagonal, system.g, delta)
        predicted += _promise(mu, system.points.V[_DIAGONAL], system.points.g, step)
        size = torch.maximum(_abs_max(delta), _abs_max(step))
        moved = []
        state = system.state
        for (block, x), part, eliminated in zip(self._blocks(state), system.relative, relative, strict=True):
            dx = block.step(part, eliminated, delta)
            predicted += _promise(mu, part.V[schur.diagonal_rows(block.size)], part.g, dx)
            size = torch.maximum(size, _abs_max(dx))
            moved.append((x + dx).clamp_min(INVERSE_DEPTH_MIN))
        T = state.T_c_w.clone()
        T[self.free] = kernel(lie.exp, self.config.compile)(delta.view(-1, 6)) @ T[self.free]
        return Step(_State(T, state.p + step, tuple(moved)), predicted, float(size))

    # -- the rest -------------------------------------------------------------------------------------------

    def refine(self) -> WindowResult:
        """Run the loop and report."""
        state, summary = minimise(self, self.start, self.config)
        chi2, in_front = self.points.chi2(state.T_c_w, state.p)
        deficiency, covariance = -1, np.full((6, 6), np.nan)
        edge_V = None
        if self.config.diagnostics and summary.stop is not StopReason.NOT_FINITE and len(self.free):
            system = self.linearise(state)
            deficiency, covariance = self._diagnose(system)
            edge_V = [part.V for part, b in zip(system.relative, self.relative, strict=True) if b.size == 1]
        stop = summary.stop if bool(in_front.any()) or self.relative else StopReason.NO_OBSERVATIONS
        edges: dict[str, Any] = {}
        junctions: dict[str, Any] = {}
        for block, x in self._blocks(state):
            if isinstance(block, EdgeBlocks):
                sigma = edge_V[0][0].rsqrt() if edge_V else torch.full_like(x[0], torch.nan)
                edges = {
                    "edge_inverse_depth": block.tiles.of_blocks(x[0]),
                    "edge_sigma": block.tiles.of_blocks(sigma),
                    "edge_chi2": block.alignment_chi2(state.T_c_w, x),
                }
            else:
                junctions = {"junction_inverse_depth": block.tiles.of_blocks(x).T.copy()}
        return WindowResult(
            T_c_w=state.T_c_w.cpu().numpy(),
            p_w=self.points.in_callers_order(state.p),
            chi2=chi2,
            in_front=in_front,
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

    def _reduce(
        self, system: _System, mu: float
    ) -> tuple[Tensor, Tensor, point_blocks.Eliminated, tuple[pair_blocks.Eliminated, ...]]:
        """Reduced pose system, its right side, and the eliminated blocks."""
        S, b = system.H.clone(), system.g.clone()
        anchors = self.points.reduce(system.points, mu, S, b)
        blocks = zip(self.relative, system.relative, strict=True)
        return S, b, anchors, tuple(block.reduce(part, mu, S, b) for block, part in blocks)

    def _diagnose(self, system: _System) -> tuple[int, FloatArray]:
        """Unobservable directions of the undamped pose system and the last free pose's covariance."""
        S, *_ = self._reduce(system, 0.0)
        scale = (system.H.diagonal() + _FLOOR).rsqrt()
        values, vectors = torch.linalg.eigh(scale[:, None] * S * scale)
        good = values > self.config.rank_tolerance * values[-1].clamp_min(_FLOOR)
        rows = vectors[-6:, good]
        covariance = (rows / values[good]) @ rows.mT * scale[-6:, None] * scale[-6:]
        return int((~good).sum()), covariance.cpu().numpy()


def _scaled_gradient(H: Tensor, g: Tensor, *blocks: PointSystem | RelativeSystem) -> float:
    """Largest gradient component in units of its own curvature."""
    parts = [(g, H.diagonal())]
    parts += [(b.g, b.V[schur.diagonal_rows(len(b.g))]) for b in blocks]
    largest = [(g.square() / (h + _FLOOR)).max() for g, h in parts if g.numel()]
    return math.sqrt(max(float(x) for x in largest)) if largest else 0.0


def _promise(mu: float, diagonal: Tensor, g: Tensor, step: Tensor) -> float:
    """Decrease of the cost predicted by the linear model, ``step^T (mu D step - g)``."""
    return float((step * (mu * diagonal * step - g)).sum())


def _abs_max(x: Tensor) -> Tensor:
    return x.abs().max() if x.numel() else x.new_zeros(())


_DIAGONAL = schur.diagonal_rows(3)
_FLOOR = 1e-30
