"""The loop itself, on problems small enough to follow by hand."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.problem import LmConfig, StopReason


@dataclass
class Curve:
    """Residuals ``r(x)`` with their Jacobian, dense."""

    x: np.ndarray
    spoil: float = 0.0
    """Added to every candidate's cost: a model that never delivers."""
    singular: bool = False
    costs: list[float] = field(default_factory=list)

    def residual(self, x: np.ndarray) -> np.ndarray:
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])  # Rosenbrock

    def linearise(self) -> tuple[float, float]:
        x = self.x
        r = self.residual(x)
        self.J, self.r = np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]), r
        self.costs.append(float(r @ r))
        return float(r @ r), float(np.abs(self.J.T @ r).max())

    def propose(self, mu: float) -> Step[np.ndarray] | None:
        if self.singular:
            return None
        H, g = self.J.T @ self.J, self.J.T @ self.r
        damped = H + mu * np.diag(np.diag(H))
        delta = -np.linalg.solve(damped, g)
        predicted = float(delta @ (mu * np.diag(H) * delta - g))
        return Step(self.x + delta, predicted, float(np.abs(delta).max()))

    def cost(self, state: np.ndarray) -> float:
        r = self.residual(state)
        return float(r @ r) + self.spoil

    def accept(self, state: np.ndarray) -> None:
        self.x = state


START = np.array([-1.2, 1.0])
MANY = LmConfig(max_iterations=200, cost_tolerance=1e-14)


def test_finds_the_bottom_of_a_bent_valley_and_never_climbs():
    curve = Curve(START)
    summary = minimise(curve, MANY)
    assert summary.stop.converged
    np.testing.assert_allclose(curve.x, [1.0, 1.0], atol=1e-6)
    assert all(b <= a for a, b in zip(curve.costs, curve.costs[1:], strict=False))
    assert summary.cost_before == pytest.approx(24.2)
    assert summary.accepted <= summary.iterations


def test_refused_steps_count_and_raise_the_damping():
    summary = minimise(Curve(START), replace(MANY, max_iterations=3, mu=1e-9))
    assert summary.iterations == 3
    assert summary.accepted < 3  # the first full Gauss-Newton step overshoots
    assert summary.stop is StopReason.MAX_ITERATIONS


def test_stalls_when_no_step_helps():
    curve = Curve(START, spoil=100.0)
    summary = minimise(curve, MANY)
    assert summary.stop is StopReason.STALLED
    assert summary.accepted == 0
    np.testing.assert_array_equal(curve.x, START)


def test_says_singular_when_no_damping_helps():
    assert minimise(Curve(START, singular=True), MANY).stop is StopReason.SINGULAR


def test_candidates_that_are_not_finite_are_refused():
    curve = Curve(START, spoil=math.nan)
    assert minimise(curve, MANY).stop is StopReason.STALLED
    np.testing.assert_array_equal(curve.x, START)


def test_a_start_that_is_not_finite_ends_at_once():
    summary = minimise(Curve(np.array([np.nan, 0.0])), MANY)
    assert summary.stop is StopReason.NOT_FINITE
    assert summary.iterations == 0


def test_starts_at_the_minimum():
    summary = minimise(Curve(np.array([1.0, 1.0])), MANY)
    assert summary.stop is StopReason.GRADIENT_CONVERGED
    assert summary.iterations == 0


@pytest.mark.parametrize("wrong", [{"max_iterations": -1}, {"mu": 0.0}, {"delta": 0.0}])
def test_config_refuses_nonsense(wrong):
    with pytest.raises(ValueError, match="must"):
        LmConfig(**wrong)
