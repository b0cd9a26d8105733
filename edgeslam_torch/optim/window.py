"""A window as a least-squares problem: cost, normal equations and steps of its poses, anchors, edges and junctions."""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.optim.blocks import Anchors, Blocks, Edges, Junctions, Normal
from edgeslam_torch.optim.kernels import rows as compiled
from edgeslam_torch.optim.kernels.normal_equations import back_substitute, eliminate, solve_triangular
from edgeslam_torch.optim.kernels.pose import stepped
from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.motion_factors import MotionTerms
from edgeslam_torch.optim.priors import PriorTerms
from edgeslam_torch.optim.problem import LmConfig, Rows, StopReason, WindowProblem, WindowResult
from edgeslam_torch.types import FloatArray

_FLOOR = 1e-30
_ZERO = 1e-9
"""Eigenvalues of the scaled reduced system below this fraction of the largest count as zero."""


@dataclass(frozen=True, slots=True)
class State:
    """Poses and blocks."""

    T_c_w: FloatArray
    """``(W, 4, 4)``."""
    x: tuple[FloatArray, ...]
    """``(B, m)`` blocks of each kind."""


@dataclass(frozen=True, slots=True)
class System:
    """Cost and normal equations at a state."""

    state: State
    cost: float
    gradient: float
    H: FloatArray
    """``(6 F, 6 F)`` of the free poses."""
    g: FloatArray
    """``(6 F,)``."""
    blocks: tuple[Normal, ...]
    """Normal equations of each kind of blocks."""


class Window:
    """One refinement; implements `levenberg_marquardt.LeastSquares`."""

    def __init__(self, problem: WindowProblem, config: LmConfig) -> None:
        self.config = config
        fixed = np.asarray(problem.pose_fixed, dtype=bool)
        column = np.where(fixed, -1, np.cumsum(~fixed) - 1)
        self.free = np.flatnonzero(~fixed)
        self.priors = PriorTerms(problem.relative_priors, problem.scale_priors, column)
        self.motion = MotionTerms(problem.centres, problem.gravity, problem.headings, column)
        rows = _modules() if config.solver == "modules" else compiled
        self.anchors = Anchors(problem, column, config, rows)
        self.blocks: list[Blocks] = [self.anchors]
        self.edges: Edges | None = None
        self.junctions: Junctions | None = None
        if problem.edges is not None and len(problem.edges.host):
            self.edges = Edges(problem, problem.edges, column, config, rows)
            self.blocks.append(self.edges)
        if problem.junctions is not None and len(problem.junctions.host):
            self.junctions = Junctions(problem, problem.junctions, column, config, rows)
            self.blocks.append(self.junctions)
        self.start = State(np.array(problem.T_c_w, dtype=np.float64), tuple(b.x for b in self.blocks))

    def linearise(self, state: State) -> System:
        """Cost and normal equations at a state."""
        size = 6 * len(self.free)
        H, g = np.zeros((size, size)), np.zeros(size)
        normals = tuple(b.normal(state.T_c_w, x, H, g) for b, x in zip(self.blocks, state.x, strict=True))
        cost = sum(n.cost for n in normals)
        cost += self.priors.linearise(state.T_c_w, H, g) + self.motion.linearise(state.T_c_w, H, g)
        parts = [(g, H.diagonal()), *((n.g, _diagonal(n)) for n in normals)]
        gradient = max((float((g * g / (h + _FLOOR)).max()) for g, h in parts if g.size), default=0.0) ** 0.5
        return System(state, cost, gradient, H, g, normals)

    def propose(self, system: System, mu: float) -> Step[State] | None:
        """Solve the damped system by eliminating anchors, edge depths and junctions."""
        S, right, factors = self._reduce(system, mu)
        diagonal = system.H.diagonal()
        np.einsum("ii->i", S)[:] += mu * diagonal + _FLOOR
        delta: FloatArray = np.zeros(len(right))
        sigmas = math.inf
        if len(delta):
            try:
                U = np.linalg.cholesky(S, upper=True)
            except np.linalg.LinAlgError:
                return None
            delta = -solve_triangular(U, right)
            sigmas = math.sqrt(max(0.0, -float(delta @ right)))
        predicted = _promise(mu, diagonal, system.g, delta)
        size = _largest(delta)
        poses = delta.reshape(-1, 6)
        x = []
        for block, was, normal, factor in zip(self.blocks, system.state.x, system.blocks, factors, strict=True):
            step = back_substitute(factor, normal.g, normal.W, block.links.start, block.links.column, poses)
            predicted += _promise(mu, _diagonal(normal), normal.g, step)
            size = max(size, _largest(step))
            x.append(block.moved(system.state.T_c_w, was, step))
        return Step(State(stepped(system.state.T_c_w, self.free, poses), tuple(x)), predicted, size, sigmas)

    def refine(self) -> WindowResult:
        """Run the solver and collect the result."""
        system, summary = minimise(self, self.start, self.config)
        x: dict[Blocks, FloatArray] = dict(zip(self.blocks, system.state.x, strict=True))
        anchors = system.blocks[0]
        deficiency, covariance = -1, np.full((6, 6), np.nan)
        if self.config.diagnostics and summary.stop is not StopReason.NOT_FINITE and len(self.free):
            deficiency, covariance = self._diagnose(system)
        observed = bool(anchors.front.any()) or len(self.blocks) > 1
        out = WindowResult(
            T_c_w=system.state.T_c_w,
            p_w=x[self.anchors],
            chi2=np.where(anchors.front, (anchors.r**2).sum(1), np.inf),
            cost_before=summary.cost_before,
            cost_after=summary.cost_after,
            iterations=summary.iterations,
            stop=summary.stop if observed else StopReason.NO_OBSERVATIONS,
            rank_deficiency=deficiency,
            pose_covariance=covariance,
        )
        if self.edges is not None:
            out = replace(out, edge_inverse_depth=x[self.edges][:, 0])
        if self.junctions is not None:
            out = replace(out, junction_inverse_depth=x[self.junctions])
        return out

    def _reduce(self, system: System, mu: float) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        """The poses' system without the blocks (on and above its diagonal), its right side, the blocks' factors."""
        S, right = system.H.copy(), system.g.copy()
        factors = [
            eliminate(n.V, n.g, n.W, block.links.start, block.links.column, mu, S, right)
            for block, n in zip(self.blocks, system.blocks, strict=True)
        ]
        return S, right, factors

    def _diagnose(self, system: System) -> tuple[int, FloatArray]:
        """Unobservable directions of the undamped pose system and the last free pose's covariance."""
        S, *_ = self._reduce(system, 0.0)
        scale = (system.H.diagonal() + _FLOOR) ** -0.5
        values, vectors = np.linalg.eigh(scale[:, None] * S * scale, "U")
        good = values > _ZERO * max(values[-1], _FLOOR)
        rows = vectors[-6:, good]
        covariance = (rows / values[good]) @ rows.T * scale[-6:, None] * scale[-6:]
        return int((~good).sum()), covariance


def _modules() -> Rows:
    from edgeslam_torch.optim import modules  # torch

    return modules


def refined(problem: WindowProblem, result: WindowResult) -> WindowProblem:
    """The window at the state that the solver found."""
    edges, junctions = problem.edges, problem.junctions
    if edges is not None:
        edges = replace(edges, inverse_depth=result.edge_inverse_depth)
    if junctions is not None:
        junctions = replace(junctions, inverse_depth=result.junction_inverse_depth)
    return replace(problem, T_c_w=result.T_c_w, p_w=result.p_w, edges=edges, junctions=junctions)


def _diagonal(normal: Normal) -> FloatArray:
    return np.einsum("bii->bi", normal.V)


def _promise(mu: float, diagonal: FloatArray, g: FloatArray, step: FloatArray) -> float:
    """Decrease of the cost predicted by the linear model, ``step^T (mu D step - g)``."""
    return float((step * (mu * diagonal * step - g)).sum())


def _largest(x: FloatArray) -> float:
    return float(np.abs(x).max()) if x.size else 0.0
