"""Looking around while exploring."""

import math

import numpy as np
import pytest

from edgeslam_torch.navigation.exploring.around import LooksAround
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.sight import Sight


def at(now_s, x, yaw_deg, tracked=True):
    return Sight(now_s, np.array([x, 0.0, 1.15]), math.radians(yaw_deg), np.zeros(3), tracked=tracked)


def looked(looks, x, yaw_deg=10.0, begin_s=0.0, seconds=12.0, turns=True):
    """Headings [degrees] that a drone has which turns by 60 degrees a second to where it is asked to look."""
    seen = []
    for k in range(round(20 * seconds)):
        wanted = looks.heading_rad(at(begin_s + k / 20, x, yaw_deg))
        if wanted is None:
            break
        error = (math.degrees(wanted) - yaw_deg + 180.0) % 360.0 - 180.0
        yaw_deg += float(np.clip(error, -3.0, 3.0)) if turns else 0.0
        seen.append(yaw_deg)
    return seen


def test_it_looks_to_both_sides_and_ahead_again():
    seen = looked(LooksAround(), 0.0)
    assert min(seen) == pytest.approx(10.0 - 75.0, abs=9.0)
    assert max(seen) == pytest.approx(10.0 + 75.0, abs=9.0)
    assert seen[-1] == pytest.approx(10.0, abs=9.0)


def test_once_about_a_place():
    looks = LooksAround()
    assert looked(looks, 0.0)
    assert not looked(looks, 1.1, begin_s=20.0)
    assert looked(looks, 1.3, begin_s=30.0)
    assert not looked(looks, 0.1, begin_s=40.0)


def test_half_way_between_two_places_is_another_one_if_it_looks_closely():
    looks = LooksAround()
    for k, x in enumerate([0.0, 1.3]):
        assert looked(looks, x, begin_s=20.0 * k)
    assert looks.heading_rad(at(50.0, 0.65, 10.0)) is None
    assert looks.heading_rad(at(51.0, 0.65, 10.0), closely=True) is not None


def test_between_is_half_way_where_it_can_be_and_has_not_been():
    looks = LooksAround()
    for k, x in enumerate([0.0, 1.3, 2.6, 5.5]):
        assert looked(looks, x, begin_s=20.0 * k)
    x, _ = np.meshgrid(np.arange(80) * 0.1, np.arange(10) * 0.1, indexing="ij")
    layer = Layer(np.abs(x - 1.9) > 0.3, np.zeros(x.shape, bool), np.array([-0.05, -0.05]), 0.1)
    assert layer.centres(looks.between(layer)) == pytest.approx(np.array([[0.65, 0.0]]), abs=0.06)
    looks.heading_rad(at(100.0, 0.66, 10.0), closely=True)
    assert len(looks.between(layer)) == 0


def test_a_lost_pose_and_a_drone_that_does_not_turn_end_it():
    looks = LooksAround()
    assert looks.heading_rad(at(0.0, 0.0, 10.0)) is not None
    assert looks.heading_rad(at(0.1, 0.0, 10.0, tracked=False)) is None
    assert looks.heading_rad(at(0.2, 0.0, 10.0)) is None
    assert len(looked(LooksAround(), 0.0, seconds=20.0, turns=False)) == pytest.approx(240, abs=2)


def test_places_go_along_with_the_map():
    """Metres become twice as long: 1.3 m from the first place is .65 of today's."""
    looks = LooksAround()
    assert looked(looks, 1.0)
    looks.carry(Moved(np.eye(4)[None], np.eye(4)[None], 2.0))
    assert not looked(looks, 1.9, begin_s=20.0)
    assert looked(looks, 0.7, begin_s=30.0)
