"""The body in moving air, against what mechanics says."""

import math

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.air import DRAG_PER_S, Air, ground_effect
from edgeslam_torch.drone.emulator.drone import DroneModel


def hovering(**fields):
    drone = DroneModel(**fields)
    drone.take_off()
    advance(drone, 5.0)
    return drone


def advance(drone, seconds):
    for _ in range(round(100 * seconds)):
        drone.step(0.01)


def test_wind_makes_a_hovering_drone_drift_as_far_as_its_controller_lets_it():
    """Balance of the controller (v / 0.35 s) and the wind's push."""
    drone = hovering(air=Air(wind_m_s=np.array([0.0, 0.3, 0.0])))
    advance(drone, 5.0)
    assert drone.velocity[1] == pytest.approx(DRAG_PER_S * 0.3 * 0.35, rel=0.05)
    assert drone.rpy()[0] > 0  # leans against it, to the right: positive roll with y left


def test_the_lean_follows_late():
    """63 % of the first lean after the attitude's time constant, before the velocity has changed much."""
    drone = hovering()
    drone.rc = (0.0, 0.2, 0.0, 0.0)
    drone.step(0.01)
    at_once = drone.rpy()[1]
    advance(drone, 0.11)
    wanted = math.atan(0.2 / 0.35 / 9.80665)
    assert at_once < 0.12 * wanted
    assert 0.45 * wanted < drone.rpy()[1] < 0.65 * wanted


def test_gusts_have_the_stated_spread():
    air = Air(gust_m_s=0.2, rng=np.random.default_rng(1))
    gusts = np.array([air.drag(np.zeros(3), 0.5) for _ in range(4000)]) / DRAG_PER_S
    np.testing.assert_allclose(gusts.std(axis=0), 0.2, rtol=0.12)


def test_near_a_wall_it_shakes_and_far_away_it_does_not():
    air = Air()
    assert not air.wash(0.5).any()
    near = np.array([air.wash(0.1) for _ in range(500)]).std()
    assert near == pytest.approx(0.25 * (1 - 0.1 / 0.35), rel=0.1)


def test_ground_effect_lifts_near_the_floor_only():
    assert ground_effect(0.05) > 0.3
    assert ground_effect(1.0) == pytest.approx(9.80665 * (0.038 / 4.0) ** 2, rel=0.01)
