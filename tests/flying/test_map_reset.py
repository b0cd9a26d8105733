"""Reset of a map without certain scale, and start pose of the next one."""

import numpy as np
import pytest

from edgeslam_torch.flying.perception.home import GROUND_M, TAKE_OFF
from edgeslam_torch.flying.perception.map_reset import IN_AIR_M, NEAR_M, PATIENCE_S, MapReset
from edgeslam_torch.types import TelemetrySample


def sample(stamp_s, velocity=(0.0, 0.0, 0.0), yaw=0.0, height_m=1.0):
    return TelemetrySample(stamp_s, np.array(velocity, float), np.array([0.0, 0.0, yaw]), height_m)


def flown(samples):
    fresh = MapReset()
    for one in samples:
        fresh.add_telemetry(one)
    return fresh


def due(fresh, until_s, sure=lambda t: False, from_s=0.0):
    """The first picture of 15 a second at which it is time."""
    return next((t for t in np.arange(from_s, until_s, 1 / 15) if fresh.is_due(t, sure(t))), None)


def test_a_map_without_metres_is_given_up_after_a_while_in_the_air_and_the_next_one_too():
    fresh = flown([sample(0.0)])
    first = due(fresh, 60.0)
    assert first == pytest.approx(PATIENCE_S, abs=0.1)
    fresh.begin()
    assert due(fresh, 60.0, from_s=first) == pytest.approx(first + PATIENCE_S, abs=0.1)


def test_metres_end_the_wait():
    assert due(flown([sample(0.0)]), 60.0, lambda t: t > 0.9 * PATIENCE_S) is None
    once = due(flown([sample(0.0)]), 60.0, lambda t: abs(t - 5.0) < 0.1)
    assert once == pytest.approx(5.1 + PATIENCE_S, abs=0.1), "metres that go again were none"


@pytest.mark.parametrize(
    "samples",
    [
        [],
        [sample(0.0, height_m=0.9 * IN_AIR_M)],
        [sample(0.0, height_m=np.nan)],
        [sample(0.0, velocity=(np.nan, 0.0, 0.0))],
        [sample(t, velocity=(0.5, 0.0, 0.0)) for t in np.arange(0.0, 2.4, 0.1)],
        [sample(t, velocity=(0.5 if t < 2.4 else -0.5, 0.0, 0.0)) for t in np.arange(0.0, 4.8, 0.1)],
    ],
    ids=["nothing told", "on the floor", "no height", "no velocity", "it has flown away", "and back"],
)
def test_what_is_not_known_to_hover_near_its_take_off_keeps_its_map(samples):
    assert due(flown(samples), 60.0) is None


def test_up_and_down_is_no_way():
    climbs = [sample(t, velocity=(0.0, 0.0, 1.0)) for t in np.arange(0.0, 3.0 * NEAR_M, 0.1)]
    assert due(flown(climbs), 60.0) is not None


def test_start_pose_is_dead_reckoned_in_axes_of_the_first_heading():
    """Half a metre along where it looks at first, a third to its left, then half a turn to the left."""
    yaw = np.deg2rad(50.0)
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    velocity = np.array([*(0.5 * ahead + 0.3 * left), 0.1])
    told = [sample(t, velocity, yaw + np.pi / 2 * t, 0.8 + 0.1 * t) for t in np.linspace(0.0, 1.0, 11)]
    place = flown(told).begin()
    np.testing.assert_allclose(place.position_m, [0.5, 0.3, 0.9 + GROUND_M], atol=1e-12)
    assert place.yaw_rad == pytest.approx(np.pi / 2)
    assert MapReset().begin() is TAKE_OFF
