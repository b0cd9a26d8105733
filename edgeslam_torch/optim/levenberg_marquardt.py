"""The Levenberg-Marquardt loop: damping, acceptance of steps, and the reason for stopping."""

import math
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from edgeslam_torch.optim.problem import LmConfig, StopReason

_MU_MIN, _MU_MAX = 1e-12, 1e8
_MU_FREE = 1e-6
"""Damping up to which a short step of the poses means that they are at the minimum: more may hold them."""
_LEAST_STEP = 1e-9
"""Largest tangent component below which a step is the last."""
_LEAST_GRADIENT = 1e-9
"""Largest gradient component, scaled by its curvature, below which the solver stops."""

S = TypeVar("S")


@dataclass(frozen=True, slots=True)
class Step(Generic[S]):
    """A proposed change of the state."""

    state: S
    """The state after the step."""
    predicted: float
    """Decrease of the cost predicted by the linear model."""
    size: float
    """Largest component of the step."""
    sigmas: float = math.inf
    """Length of the poses' part in standard deviations; infinite without free poses."""


class Linearised(Protocol):
    """A state's cost and normal equations."""

    @property
    def cost(self) -> float:
        """Robust cost."""
        ...

    @property
    def gradient(self) -> float:
        """Largest ``|g_i| / sqrt(H_ii)``."""
        ...


L = TypeVar("L", bound=Linearised)


class LeastSquares(Protocol[S, L]):
    """Interface of a least-squares problem."""

    def linearise(self, state: S) -> L:
        """Cost and normal equations at a state."""
        ...

    def propose(self, system: L, mu: float) -> Step[S] | None:
        """Solve the damped system; None when it is not positive definite."""
        ...


@dataclass(frozen=True, slots=True)
class LmSummary:
    """Summary of a minimisation."""

    cost_before: float
    cost_after: float
    iterations: int
    accepted: int
    stop: StopReason
    mu: float
    """Final damping."""


def minimise(problem: LeastSquares[S, L], start: S, config: LmConfig) -> tuple[L, LmSummary]:
    """Minimise a robust sum of squares; returns the last state's normal equations and a summary.

    The damping follows Nielsen (1999): it shrinks with the agreement of predicted and actual decrease, and grows by a
    doubling factor with every rejected step. Only states of lower, finite cost are accepted.
    """
    system = problem.linearise(start)
    first, mu, nu, accepted, tried = system.cost, config.mu, 2.0, 0, 0

    def ended(stop: StopReason) -> tuple[L, LmSummary]:
        return system, LmSummary(first, system.cost, tried, accepted, stop, mu)

    if not (math.isfinite(first) and math.isfinite(system.gradient)):
        return ended(StopReason.NOT_FINITE)
    if system.gradient < _LEAST_GRADIENT:
        return ended(StopReason.GRADIENT_CONVERGED)
    solved = False
    lengths: list[float] = []
    while tried < config.max_iterations:
        tried += 1
        step = problem.propose(system, mu)
        if step is not None:
            solved = True
            if step.size < _LEAST_STEP:
                return ended(StopReason.STEP_CONVERGED)
            trial = problem.linearise(step.state)
            decrease = system.cost - trial.cost
            if math.isfinite(trial.cost) and decrease >= 0.0 and step.predicted > 0.0:
                small = decrease <= config.cost_tolerance * system.cost
                lengths = [step.sigmas, *lengths[:2]]
                still = mu <= _MU_FREE and _remaining(lengths) < config.pose_tolerance
                ratio = decrease / step.predicted
                system = trial
                accepted += 1
                mu = max(_MU_MIN, mu * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3))
                nu = 2.0
                if small:
                    return ended(StopReason.COST_CONVERGED)
                if still:
                    return ended(StopReason.STEP_CONVERGED)
                if not math.isfinite(system.gradient):
                    return ended(StopReason.NOT_FINITE)
                if system.gradient < _LEAST_GRADIENT:
                    return ended(StopReason.GRADIENT_CONVERGED)
                continue
            if abs(decrease) <= 1e-12 * system.cost and math.isfinite(trial.cost):
                return ended(StopReason.COST_CONVERGED)  # the minimum, up to rounding
        mu *= nu
        nu *= 2.0
        if mu > _MU_MAX:
            return ended(StopReason.STALLED if solved else StopReason.SINGULAR)
    return ended(StopReason.MAX_ITERATIONS)


def _remaining(lengths: list[float]) -> float:
    """Distance to the minimum that is expected after steps of these lengths, the last one first.

    Robust weights make the convergence linear, and slow where depths are uncertain: a short step alone is not
    convergence.
    """
    rate = max((lengths[0] / lengths[k]) ** (1.0 / k) for k in range(1, len(lengths))) if len(lengths) > 1 else 0.5
    return lengths[0] * max(1.0, rate / (1.0 - rate)) if rate < 1.0 else math.inf
