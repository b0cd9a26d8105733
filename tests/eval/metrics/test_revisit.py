import numpy as np
import pytest

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.revisit import return_error_percent, returns


def trajectory(p):
    T = np.tile(np.eye(4), (len(p), 1, 1))
    T[:, :3, 3] = p
    return Trajectory(0.1 * np.arange(len(p)), T)


def circle(rounds, radius=3.0):
    angle = np.linspace(0.0, 2 * np.pi * rounds, 400)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=1)


def test_drift_of_height_is_found_at_the_return():
    """A step of 20 cm in height after half a round of 18.8 m: 1.06 % of the way between two passes."""
    true = circle(1.2)
    wrong = true.copy()
    wrong[170:, 2] += 0.2
    assert return_error_percent(trajectory(true), trajectory(wrong)) == pytest.approx(1.06, rel=0.1)


def test_another_gauge_is_no_error():
    true = circle(1.2)
    assert return_error_percent(trajectory(true), trajectory(2.5 * true[:, [1, 2, 0]] + 7.0)) < 1e-9


@pytest.mark.parametrize("p", [circle(0.9), circle(1.2, radius=1.0)])
def test_where_nothing_returns_from_far_there_is_no_error(p):
    assert np.isnan(return_error_percent(trajectory(p), trajectory(p)))


def test_figures_of_a_run():
    true = circle(1.2)
    assert returns(trajectory(true), trajectory(true), None)["return_percent"] < 1e-9
    assert np.isnan(returns(trajectory(true), trajectory(true), None)["return_online_percent"])
    assert returns(trajectory(true), trajectory(0.0 * true), None) == {}
