"""Simulated IMU: its noise-free readings integrate to the trajectory, and its noise has the stated densities."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.synthetic.flights.courses import COURSES, flown
from edgeslam_torch.synthetic.flights.imu import ADIS16448, EXACT, MPU6050, ImuErrors, mounted, simulate_imu

T_IMU_CAM = se3.exp(np.array([0.05, -0.03, 0.02, 1.2, -1.1, 0.9]))


def still(seconds=30.0):
    stamps_s = np.arange(0.0, seconds, 1 / 30)
    return stamps_s, np.tile(np.eye(4), (len(stamps_s), 1, 1))


@pytest.mark.parametrize("offset_s", [0.0, 0.03])
def test_noise_free_readings_integrate_to_the_trajectory(offset_s):
    _, flight, rng = flown(COURSES["room"], 0, 12.0)
    model = mounted(ADIS16448, T_IMU_CAM, offset_s, rate_hz=500.0)
    readings = simulate_imu(rng, flight.stamps_s, flight.T_w_c, model, errors=EXACT)
    T_w_imu = flight.T_w_c @ se3.inverse(T_IMU_CAM)
    dt, g = 2e-3, np.array([0.0, 0.0, 9.81])
    rate, force = readings.angular_rate_rad_s, readings.acceleration_m_s2
    turns = [T_w_imu[0, :3, :3]]
    for step in Rotation.from_rotvec(0.5 * dt * (rate[:-1] + rate[1:])).as_matrix():
        turns.append(turns[-1] @ step)
    R = np.array(turns)
    a = np.einsum("nij,nj->ni", R, force) - g
    a = 0.5 * (a[:-1] + a[1:])
    v = (T_w_imu[1, :3, 3] - T_w_imu[0, :3, 3]) / (flight.stamps_s[1] - flight.stamps_s[0])
    v = v + np.vstack([np.zeros(3), np.cumsum(a * dt, axis=0)])
    p = T_w_imu[0, :3, 3] + np.vstack([np.zeros(3), np.cumsum(v[:-1] * dt + 0.5 * a * dt**2, axis=0)])
    at = np.rint((flight.stamps_s - flight.stamps_s[0]) / dt).astype(int)
    at = at[at < len(p)]
    moments_s = readings.stamps_s[at] - offset_s
    assert moments_s == pytest.approx(flight.stamps_s[: len(at)], abs=dt)
    # The first velocity is a difference, and stamps are rounded to dt.
    drift = p[at] - T_w_imu[: len(at), :3, 3]
    slope = np.polyfit(moments_s, drift, 1)
    assert np.abs(slope[0]).max() < 0.03
    assert np.abs(drift - np.outer(moments_s, slope[0]) - slope[1]).max() < 2e-3
    off = [Rotation.from_matrix(R[i].T @ T[:3, :3]).magnitude() for i, T in zip(at, T_w_imu, strict=False)]
    assert max(off) < 2e-3


def test_a_still_level_imu_feels_gravity_upwards():
    exact = simulate_imu(np.random.default_rng(0), *still(), MPU6050, errors=EXACT)
    assert exact.acceleration_m_s2 == pytest.approx(np.tile([0, 0, 9.81], (len(exact), 1)))
    assert exact.angular_rate_rad_s == pytest.approx(np.zeros((len(exact), 3)), abs=1e-12)


@pytest.mark.parametrize("model", [MPU6050, ADIS16448])
def test_noise_and_bias_walk_have_the_stated_densities(model):
    readings = simulate_imu(np.random.default_rng(1), *still(400.0), model, errors=ImuErrors(1.0, 0.0, 0.0))
    rate, force = readings.angular_rate_rad_s, readings.acceleration_m_s2 - [0, 0, 9.81]
    for values, density, walk in (
        (rate, model.gyroscope_noise_density, model.gyroscope_random_walk),
        (force, model.accelerometer_noise_density, model.accelerometer_random_walk),
    ):
        assert np.diff(values, axis=0).std() == pytest.approx(density * np.sqrt(2 * model.rate_hz), rel=0.02)
        means = values[: len(values) // 1000 * 1000].reshape(-1, 1000, 3).mean(axis=1)  # of 5 s
        steps = np.diff(means, axis=0).std()
        # Difference of the means of two successive intervals: white noise, and two thirds of the walk over one.
        assert steps == pytest.approx(np.sqrt(2 * density**2 / 5.0 + 2 / 3 * walk**2 * 5.0), rel=0.2)


def test_readings_are_the_same_for_a_seed_and_clipped_at_the_range():
    errors = ImuErrors(accelerometer_range_m_s2=9.8)
    a, b = (simulate_imu(np.random.default_rng(2), *still(), MPU6050, errors=errors) for _ in range(2))
    assert a.acceleration_m_s2.tobytes() == b.acceleration_m_s2.tobytes()
    assert a.acceleration_m_s2.max() == 9.8


def test_noisy_poses_are_smoothed(rng):
    stamps_s, T = still(20.0)
    T[:, :3, 3] += 1e-3 * rng.standard_normal((len(T), 3))
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(2e-3 * rng.standard_normal((len(T), 3))).as_matrix()
    readings = simulate_imu(rng, stamps_s, T, MPU6050, errors=EXACT, knots_s=0.2)
    inside = slice(100, -100)
    assert np.abs(readings.acceleration_m_s2[inside] - [0, 0, 9.81]).max() < 0.5
    assert np.abs(readings.angular_rate_rad_s[inside]).max() < 0.05
