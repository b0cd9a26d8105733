"""The Levenberg-Marquardt loop: damping, acceptance, and a stated reason for stopping."""

import math
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from edgeslam_torch.optim.problem import LmConfig, StopReason

_MU_MIN = 1e-12
_LIKELY_LAST = 2.0
"""Factor on the cost tolerance: a step with a smaller predicted decrease is likely the last."""

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

    def cost(self, state: S) -> float:
        """Robust cost of a state alone, for less than `linearise` takes."""
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


def minimise(problem: LeastSquares[S, L], start: S, config: LmConfig) -> tuple[S, LmSummary]:
    """Minimise a robust sum of squares; returns the last state and how it went.

    The damping follows Nielsen (1999): it shrinks with the agreement of predicted and actual decrease, and grows by a
    doubling factor with every rejected step. Only states of lower, finite cost are accepted.

    Most steps are accepted, and the next one then needs the normal equations at the new state: so a step is
    linearised at once, which yields its cost as well. For a step that looks like the last (no iteration left, or a
    predicted decrease near the tolerance) only the cost is evaluated.
    """
    state, system = start, problem.linearise(start)
    cost, mu, nu, accepted, tried = system.cost, config.mu, 2.0, 0, 0
    first = cost

    def ended(stop: StopReason) -> tuple[S, LmSummary]:
        return state, LmSummary(first, cost, tried, accepted, stop, mu)

    if not (math.isfinite(cost) and math.isfinite(system.gradient)):
        return ended(StopReason.NOT_FINITE)
    if system.gradient < config.gradient_tolerance:
        return ended(StopReason.GRADIENT_CONVERGED)
    solved = False
    while tried < config.max_iterations:
        tried += 1
        step = problem.propose(system, mu)
        trial: L | None = None
        candidate = math.inf
        if step is not None:
            solved = True
            if step.size < config.step_tolerance:
                return ended(StopReason.STEP_CONVERGED)
            if tried < config.max_iterations and step.predicted > _LIKELY_LAST * config.cost_tolerance * cost:
                trial = problem.linearise(step.state)
                candidate = trial.cost
            else:
                candidate = problem.cost(step.state)
            decrease = cost - candidate
            if math.isfinite(candidate) and decrease >= 0.0 and step.predicted > 0.0:
                small = decrease <= config.cost_tolerance * cost
                ratio = decrease / step.predicted
                state, cost = step.state, candidate
                accepted += 1
                mu = max(_MU_MIN, mu * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3))
                nu = 2.0
                if small:
                    return ended(StopReason.COST_CONVERGED)
                if tried == config.max_iterations:
                    break
                system = problem.linearise(state) if trial is None else trial
                if not math.isfinite(system.gradient):
                    return ended(StopReason.NOT_FINITE)
                if system.gradient < config.gradient_tolerance:
                    return ended(StopReason.GRADIENT_CONVERGED)
                continue
            if abs(decrease) <= 1e-12 * cost and math.isfinite(candidate):
                return ended(StopReason.COST_CONVERGED)  # the minimum, to the last digits
        mu *= nu
        nu *= 2.0
        if mu > config.mu_max:
            return ended(StopReason.STALLED if solved else StopReason.SINGULAR)
    return ended(StopReason.MAX_ITERATIONS)
