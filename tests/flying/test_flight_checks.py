"""What is refused before anything moves."""

import numpy as np
import pytest

from edgeslam_torch.flying.checks import check_fit, check_goal
from edgeslam_torch.flying.result import FlightRefused
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits

LIMITS = NavLimits(fence_m=5.0)


def walled():
    """Free all around, with a wall across at x = 2."""
    free = np.ones((60, 60), bool)
    solid = np.zeros((60, 60), bool)
    solid[50, :], free[50, :] = True, False
    return Layer(free, solid, np.array([-3.0, -3.0]), 0.1)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ((1.0, float("nan"), 1.15), "finite"),
        ((1.0, float("inf"), 1.15), "finite"),
        ((1.0, 2.0), "three"),
        ("there", "three numbers"),
        ((4.0, 3.1, 1.15), "fence"),
        ((1.0, 0.0, 1.8), "high"),
        ((2.05, 0.3, 1.15), "obstacle"),
    ],
)
def test_goals_that_make_no_sense(goal, words):
    with pytest.raises(FlightRefused, match=words):
        check_goal(goal, LIMITS, walled())


@pytest.mark.parametrize("goal", [(1.0, 0.0, 1.15), (1.8, 0.0, 1.0), (-4.0, 0.0, 1.15), (4.0, 2.9, 1.15)])
def test_goals_that_do_also_beyond_what_is_known(goal):
    assert check_goal(goal, LIMITS, walled()) == pytest.approx(goal)


@pytest.mark.parametrize(
    ("allowed", "battery", "guessed", "words"),
    [(False, 1.0, False, "--fly"), (True, 0.2, False, "battery at 20 %"), (True, 1.0, True, "calibration")],
)
def test_drones_that_should_not_rise(allowed, battery, guessed, words):
    with pytest.raises(FlightRefused, match=words):
        check_fit(allowed, battery, LIMITS, guessed)


def test_a_fit_drone_may_rise():
    check_fit(True, 0.5, LIMITS, False)
    check_fit(True, float("nan"), LIMITS, False)
