"""The drone's own world, and the metres that it goes by."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.flying.perception.home import GROUND_M, Home, metres_per_unit
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.types import FrameStatus, ScaleEstimate, SlamOutput

T_B_C = camera_on_body()
METRES = 1.3


def pose(yaw_deg, p):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix(), p
    return T


def published(T_w_b):
    """``T_w_c`` of a body at ``T_w_b`` [m] in a world whose unit is 1.3 m."""
    T_w_c = T_w_b @ T_B_C
    T_w_c[:3, 3] /= METRES
    return T_w_c


def test_the_first_body_is_the_origin_on_the_floor_and_the_second_where_it_flew():
    first, second = pose(30.0, [2.0, -1.0, 0.7]), pose(75.0, [3.0, 0.5, 1.6])
    home = Home.of(published(first), METRES, T_B_C)
    bodies = home.poses(np.array([published(first), published(second)])) @ se3.inverse(T_B_C)
    np.testing.assert_allclose(bodies[0], pose(0.0, [0.0, 0.0, GROUND_M]), atol=1e-12)
    step = pose(-30.0, [0, 0, 0])[:3, :3] @ (second[:3, 3] - first[:3, 3])
    np.testing.assert_allclose(bodies[1], pose(45.0, step + [0.0, 0.0, GROUND_M]), atol=1e-12)


def output(scale, sigma=0.02, metric=True):
    estimate = ScaleEstimate(scale, sigma, "telemetry")
    return SlamOutput(0, 0.0, np.eye(4), FrameStatus.TRACKED, "", 0, 0, 0.0, False, 0, estimate, metric, 0, {})


@pytest.mark.parametrize(
    ("known", "newest", "late", "metres"),
    [
        (math.nan, output(0.6), True, 0.6),
        (0.6, output(0.62), True, 0.62),
        (0.6, output(0.58), True, 0.58),
        (0.6, output(0.603), True, 0.6),
        (0.6, output(0.62), False, 0.6),
        (0.6, output(0.3), False, 0.3),
        (math.nan, output(0.6), False, 0.6),
        (0.6, output(0.62, metric=False), True, 0.6),
        (0.6, output(1.0, sigma=math.inf), True, 0.6),
        (0.6, output(0.53, sigma=0.11), True, 0.6),
        (0.6, output(0.4, sigma=0.05), True, 0.4),
        (math.nan, output(0.53, sigma=0.11), True, 0.53),
    ],
    ids=[
        "first",
        "grew",
        "shrank",
        "hardly",
        "soon",
        "wrong",
        "first soon",
        "no metres",
        "no sigma",
        "unsure",
        "no room",
        "rough",
    ],
)
def test_it_goes_by_the_best_estimate_where_that_is_worth_a_move(known, newest, late, metres):
    assert metres_per_unit(known, newest, late) == metres


def test_without_metres_nothing_is_known():
    assert math.isnan(metres_per_unit(math.nan, output(0.6, metric=False), late=True))
