"""Simulated flights."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.synthetic.flights.flight import FlightPlan, fly
from edgeslam_torch.synthetic.flights.paths import inspect


@pytest.mark.parametrize("seed", range(3))
def test_flight_is_smooth_slow_and_clear_of_furniture(home, seed):
    plan = FlightPlan()
    flight = fly(np.random.default_rng(seed), home, 900, inspect, plan=plan)
    speed = np.linalg.norm(flight.velocity_w, axis=1)
    assert np.median(speed) > 0.25 and speed.max() < 1.0
    yaw = np.unwrap(Rotation.from_matrix(flight.T_w_b[:, :3, :3]).as_euler("ZYX")[:, 0])
    assert np.abs(np.gradient(yaw, flight.stamps_s)).max() < np.deg2rad(60)
    jerk = np.diff(flight.T_w_b[:, :3, 3], 3, axis=0) * 30**3
    assert np.abs(jerk).max() < 30.0  # 1 m/s from one frame to the next would show 900
    flying = flight.T_w_b[:, 2, 3] > 0.9
    assert home.clearance(flight.T_w_b[flying, :3, 3]).min() > plan.clearance_m - 0.1


def test_flight_velocity_is_the_derivative_of_position(flight):
    difference = np.gradient(flight.T_w_b[:, :3, 3], flight.stamps_s, axis=0)
    np.testing.assert_allclose(difference[1:-1], flight.velocity_w[1:-1], atol=2e-3)


def test_it_leans_as_its_acceleration_needs(home):
    """The force that a body feels lies along its own up."""
    flight = fly(np.random.default_rng(3), home, 300, inspect, plan=FlightPlan(wobble_m=0.0, wobble_rad=0.0))
    force = np.gradient(np.gradient(flight.T_w_b[:, :3, 3], flight.stamps_s, axis=0), flight.stamps_s, axis=0)
    force += [0.0, 0.0, 9.81]
    cos = (force * flight.T_w_b[:, :3, 2]).sum(1) / np.linalg.norm(force, axis=1)
    assert np.degrees(np.arccos(np.clip(cos[2:-2], -1.0, 1.0))).max() < 0.3


def test_twist_carries_one_pose_to_the_next(flight):
    k, dt = 400, 2 / 30
    there = flight.T_w_c[k - 1] @ se3.exp(flight.twist_c(k) * dt)
    np.testing.assert_allclose(there, flight.T_w_c[k + 1], atol=1e-9)


def test_flight_starts_low_and_climbs(flight):
    z = flight.T_w_b[:, 2, 3]
    assert z[0] == pytest.approx(0.4, abs=0.02)
    assert 0.7 < z[150:].min() < z.max() < 1.7


def test_flight_without_air_is_refused(home):
    with pytest.raises(ValueError, match="free air"):
        fly(np.random.default_rng(0), home, 30, inspect, plan=FlightPlan(clearance_m=4.0))
