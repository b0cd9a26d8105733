"""Which frames rest on the map, from status tables and maps written by hand."""

import numpy as np
import pytest

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.run_figures import at_end, live, points_in_view, return_error_percent, returns
from edgeslam_torch.geometry.camera import Camera

CAMERA = Camera(100, 80, 100.0, 100.0, 49.5, 39.5)
WALL = np.stack([*np.meshgrid(np.linspace(-0.3, 0.3, 10), np.linspace(-0.3, 0.3, 10)), np.full((10, 10), 2.0)], -1)
POINTS = WALL.reshape(-1, 3)
ROWS = [
    {"status": "starting", "supported": "1"},  # posed again once the map stood
    {"status": "starting", "supported": "0"},
    {"status": "tracked", "supported": "1"},
    {"status": "predicted", "supported": "0"},
    {"status": "relocalised", "supported": "1"},
    {"status": "lost", "supported": "0"},
]


def ended(p_w):
    return at_end(ROWS, np.tile(np.eye(4), (len(ROWS), 1, 1)), p_w, CAMERA).tolist()


def test_final_support_is_what_the_run_says():
    assert ended(POINTS) == [True, False, True, False, True, False]
    assert live(ROWS).tolist() == [False, False, True, False, True, False]


def test_frame_that_sees_none_of_the_delivered_map_does_not_rest_on_it():
    assert not any(ended(POINTS[:20])), "fewer than 30 points"
    assert not any(ended(POINTS * [1, 1, -1])), "the map lies behind the camera"
    assert not any(ended(np.zeros((0, 3))))


def test_points_in_view_are_counted_by_projection():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 1.0  # a metre to the right: the half image is 1 m wide at 2 m, so that x >= 0 stays
    assert points_in_view(T, POINTS, CAMERA).tolist() == [100, 50]
    assert points_in_view(T, np.zeros((0, 3)), CAMERA).tolist() == [0, 0]


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
    found = returns(trajectory(true), trajectory(wrong), trajectory(2.5 * true[:, [1, 2, 0]] + 7.0))
    assert found["return_percent"] == pytest.approx(1.06, rel=0.1)
    assert found["return_online_percent"] < 1e-9, "another gauge is no error"
    assert np.isnan(returns(trajectory(true), trajectory(true), None)["return_online_percent"])
    assert returns(trajectory(true), trajectory(0.0 * true), None) == {}


@pytest.mark.parametrize("p", [circle(0.9), circle(1.2, radius=1.0)])
def test_where_nothing_returns_from_far_there_is_no_error(p):
    assert np.isnan(return_error_percent(trajectory(p), trajectory(p)))
