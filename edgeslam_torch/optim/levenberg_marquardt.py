"""The Levenberg-Marquardt loop: damping, acceptance, and a stated reason for stopping."""

import math
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from edgeslam_torch.optim.problem import LmConfig, StopReason

_MU_MIN = 1e-12

S = TypeVar("S")


@dataclass(frozen=True, slots=True)
class Step(Generic[S]):
    """A proposed change of the state."""

    state: S
    """The state after the step."""
    predicted: float
    """Decrease of the cost that the linear model promises."""
    size: float
    """Largest component of the step."""


class LeastSquares(Protocol[S]):
    """What the loop needs from a problem; implementations keep the state and the linear system."""

    def linearise(self) -> tuple[float, float]:
        """Cost and largest ``|g_i| / sqrt(H_ii)`` at the current state; prepares `propose`."""
        ...

    def propose(self, mu: float) -> Step[S] | None:
        """Solve the damped system; None when it is not positive definite."""
        ...

    def cost(self, state: S) -> float:
        """Robust cost of a candidate state."""
        ...

    def accept(self, state: S) -> None:
        """Make the candidate the current state."""
        ...


@dataclass(frozen=True, slots=True)
class LmSummary:
    """How a minimisation went."""

    cost_before: float
    cost_after: float
    iterations: int
    accepted: int
    stop: StopReason
    mu: float
    """Damping at the end."""


def minimise(problem: LeastSquares[S], config: LmConfig) -> LmSummary:
    """Minimise a robust sum of squares.

    The damping follows Nielsen (1999): it shrinks with the agreement between promised and real decrease, and
    grows by a doubling factor with every refusal. The state only ever changes to one of lower, finite cost.
    """
    cost, gradient = problem.linearise()
    first, mu, nu, accepted, tried = cost, config.mu, 2.0, 0, 0
    if not (math.isfinite(cost) and math.isfinite(gradient)):
        return LmSummary(cost, cost, 0, 0, StopReason.NOT_FINITE, mu)
    if gradient < config.gradient_tolerance:
        return LmSummary(cost, cost, 0, 0, StopReason.GRADIENT_CONVERGED, mu)
    stop = StopReason.MAX_ITERATIONS
    solved = False
    while tried < config.max_iterations:
        tried += 1
        step = problem.propose(mu)
        candidate = math.inf if step is None else problem.cost(step.state)
        if step is not None:
            solved = True
            if step.size < config.step_tolerance:
                stop = StopReason.STEP_CONVERGED
                break
            decrease = cost - candidate
            if math.isfinite(candidate) and decrease >= 0.0 and step.predicted > 0.0:
                problem.accept(step.state)
                accepted += 1
                small = decrease <= config.cost_tolerance * cost
                ratio = decrease / step.predicted
                cost = candidate
                mu = max(_MU_MIN, mu * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3))
                nu = 2.0
                if small:
                    stop = StopReason.COST_CONVERGED
                    break
                if tried == config.max_iterations:
                    break
                _, gradient = problem.linearise()
                if not math.isfinite(gradient):
                    stop = StopReason.NOT_FINITE
                    break
                if gradient < config.gradient_tolerance:
                    stop = StopReason.GRADIENT_CONVERGED
                    break
                continue
            if abs(decrease) <= 1e-12 * cost and math.isfinite(candidate):
                stop = StopReason.COST_CONVERGED  # the minimum, to the last digits
                break
        mu *= nu
        nu *= 2.0
        if mu > config.mu_max:
            stop = StopReason.STALLED if solved else StopReason.SINGULAR
            break
    return LmSummary(first, cost, tried, accepted, stop, mu)
