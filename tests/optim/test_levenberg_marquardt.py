"""Levenberg-Marquardt on problems small enough to work by hand."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from edgeslam_torch.optim.levenberg_marquardt import Step, minimise
from edgeslam_torch.optim.problem import LmConfig, StopReason


@dataclass(frozen=True)
class Linear:
    """Residuals and Jacobian at ``x``, dense."""

    x: np.ndarray
    J: np.ndarray
    r: np.ndarray
    cost: float

    @property
    def gradient(self) -> float:
        return float(np.abs(self.J.T @ self.r).max())


@dataclass
class Curve:
    """Residuals ``r(x)``; counts its evaluations."""

    spoil: float = 0.0
    """Added to every candidate's cost, so that no step is accepted."""
    singular: bool = False
    linearised: list[Linear] = field(default_factory=list)
    proposed: list[float] = field(default_factory=list)
    """Costs of the states from which steps were proposed."""

    def residual(self, x: np.ndarray) -> np.ndarray:
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])  # Rosenbrock

    def linearise(self, state: np.ndarray) -> Linear:
        cost = float(np.square(self.residual(state)).sum()) + (self.spoil if self.linearised else 0.0)
        J = np.array([[-20.0 * state[0], 10.0], [-1.0, 0.0]])
        self.linearised.append(Linear(state, J, self.residual(state), cost))
        return self.linearised[-1]

    def propose(self, system: Linear, mu: float) -> Step[np.ndarray] | None:
        self.proposed.append(system.cost)
        if self.singular:
            return None
        H, g = system.J.T @ system.J, system.J.T @ system.r
        damped = H + mu * np.diag(np.diag(H))
        delta = -np.linalg.solve(damped, g)
        predicted = float(delta @ (mu * np.diag(H) * delta - g))
        return Step(system.x + delta, predicted, float(np.abs(delta).max()))


START = np.array([-1.2, 1.0])
MANY = LmConfig(max_iterations=200, cost_tolerance=1e-14)


def test_finds_the_minimum_of_a_curved_valley_with_decreasing_cost():
    curve = Curve()
    end, summary = minimise(curve, START, MANY)
    assert summary.stop.converged
    np.testing.assert_allclose(end.x, [1.0, 1.0], atol=1e-6)
    assert all(b <= a for a, b in zip(curve.proposed, curve.proposed[1:], strict=False))
    assert summary.cost_before == pytest.approx(24.2)
    assert summary.accepted <= summary.iterations


def test_no_state_is_linearised_twice_and_the_best_is_returned():
    curve = Curve()
    end, summary = minimise(curve, START, replace(MANY, max_iterations=4))
    states = [tuple(x.x) for x in curve.linearised]
    assert len(set(states)) == len(states) == 5  # the start, and all steps
    assert end.cost == min(x.cost for x in curve.linearised) == summary.cost_after
    assert summary.accepted < 4


@pytest.mark.parametrize("spoil", [100.0, np.nan])
def test_stalls_when_no_step_helps(spoil):
    end, summary = minimise(Curve(spoil=spoil), START, MANY)
    assert summary.stop is StopReason.STALLED
    assert summary.accepted == 0
    np.testing.assert_array_equal(end.x, START)


def test_reports_singular_when_no_damping_helps():
    assert minimise(Curve(singular=True), START, MANY)[1].stop is StopReason.SINGULAR


def test_a_start_that_is_not_finite_ends_at_once():
    _, summary = minimise(Curve(), np.array([np.nan, 0.0]), MANY)
    assert summary.stop is StopReason.NOT_FINITE
    assert summary.iterations == 0


def test_starts_at_the_minimum():
    _, summary = minimise(Curve(), np.array([1.0, 1.0]), MANY)
    assert summary.stop is StopReason.GRADIENT_CONVERGED
    assert summary.iterations == 0


@pytest.mark.parametrize("wrong", [{"max_iterations": -1}, {"mu": 0.0}])
def test_config_rejects_invalid_values(wrong):
    with pytest.raises(ValueError, match="must"):
        LmConfig(**wrong)


@dataclass
class Distance:
    """One variable in standard deviations from the minimum, which every step shortens by the same rate."""

    rate: float

    def linearise(self, state: float) -> Linear:
        return Linear(np.array([state]), np.eye(1), np.array([state]), state**2)

    def propose(self, system: Linear, mu: float) -> Step[float]:
        x = float(system.x[0])
        return Step(self.rate * x, (1.0 - self.rate**2) * x**2, abs(x), sigmas=(1.0 - self.rate) * x)


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.9, 0.97])
def test_ends_within_the_tolerance_of_the_minimum_however_slow_the_steps(rate):
    config = LmConfig(mu=1e-9, max_iterations=500, cost_tolerance=0.0, pose_tolerance=0.5)
    end, summary = minimise(Distance(rate), 20.0, config)
    assert summary.stop is StopReason.STEP_CONVERGED
    assert 0.0 < end.x[0] <= 0.5
    assert end.x[0] / rate**2 > 0.4  # and not much later than that


def test_short_steps_under_damping_do_not_end_the_search():
    config = LmConfig(mu=1.0, max_iterations=5, cost_tolerance=0.0, pose_tolerance=1e9)
    assert minimise(Distance(0.9), 20.0, config)[1].iterations > 1
