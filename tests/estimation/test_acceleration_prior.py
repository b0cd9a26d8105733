"""What a camera's mass says of its positions."""

import numpy as np
import pytest

from edgeslam_torch.estimation.acceleration_prior import inertia
from edgeslam_torch.noise import IMPLAUSIBLE_ACCELERATION_M_S2


def cost(stamps, p, metres=1.0):
    x = np.asarray(p, dtype=np.float64).ravel()
    return float(x @ inertia(np.asarray(stamps), metres) @ x)


def along_x(x):
    return np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])


def test_an_even_motion_costs_nothing_whatever_the_gaps(rng):
    stamps = np.cumsum(rng.uniform(0.03, 0.4, 8))
    assert cost(stamps, rng.normal(size=3) + stamps[:, None] * rng.normal(size=3)) < 1e-9


def test_acceleration_of_one_sigma_costs_one_per_inner_frame():
    """Positions of a constant acceleration: velocities between pictures change by it times half of both gaps."""
    stamps = np.array([0.0, 0.1, 0.3, 0.4])
    assert cost(stamps, along_x(0.5 * IMPLAUSIBLE_ACCELERATION_M_S2 * stamps**2)) == pytest.approx(2.0)


def test_cost_does_not_depend_on_the_map_unit():
    stamps = np.array([0.0, 0.1, 0.25])
    way_m = along_x(np.array([0.0, 0.0, 0.4]))
    assert cost(stamps, way_m / 7.0, metres=7.0) == pytest.approx(cost(stamps, way_m))


def test_jump_costs_and_gap_is_unconstrained():
    x = along_x(np.array([7.6, 0.0, 0.1]))
    assert cost([0.0, 0.1, 0.25], x) > 900.0
    assert inertia(np.array([0.0, 0.6, 0.7]), 1.0) is None
    assert inertia(np.array([0.0, 0.1]), 1.0) is None
