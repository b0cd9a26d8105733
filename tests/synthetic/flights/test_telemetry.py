"""Telemetry of a flight: by hand, and against the poses that it is made from."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.readers.telemetry_csv import read_telemetry
from edgeslam_torch.synthetic.flights.flight import fly
from edgeslam_torch.synthetic.flights.paths import inspect
from edgeslam_torch.synthetic.flights.telemetry import EXACT, FIELDS, TelemetryFaults, simulate
from edgeslam_torch.synthetic.house.world import Quad, Texture, World


@pytest.fixture(scope="module")
def flight():
    """In an empty room."""
    texture = Texture(np.zeros((4, 4, 3), np.uint8))
    floor = Quad(np.array([-4.0, 4.0, 0.0]), np.array([8.0, 0.0, 0.0]), np.array([0.0, -8.0, 0.0]), texture)
    room = World([floor], bounds_w=np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 2.6]]))
    return fly(np.random.default_rng(3), room, 900, inspect)


def simulated(flight, faults=EXACT, **more):
    return simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=faults, **more)


def test_integrated_exact_velocity_reproduces_the_path(flight):
    log = simulated(flight)
    samples = log.samples()
    v = np.stack([s.velocity_m_s for s in samples])
    moved = np.cumsum(v[1:], axis=0) * 0.1  # each is the mean over the tenth of a second around its stamp
    yaw0 = Rotation.from_matrix(flight.T_w_b[0, :3, :3]).as_euler("ZYX")[0]
    truth = Rotation.from_euler("z", -yaw0).apply(flight.T_w_b[:, :3, 3] - flight.T_w_b[0, :3, 3])
    half = np.stack([np.interp(log.stamps_s[1:] + 0.05, flight.stamps_s, truth[:, k]) for k in range(3)], axis=1)
    start = np.array([np.interp(0.05, flight.stamps_s, truth[:, k]) for k in range(3)])
    np.testing.assert_allclose(moved[:-1], half[:-1] - start, atol=5e-3)


def test_exact_attitude_height_and_force_follow_the_pose(flight):
    log = simulated(flight, floor_m=0.0)
    samples = log.samples()
    sample = samples[120]
    index = int(np.argmin(np.abs(flight.stamps_s - sample.stamp_s)))
    yaw0 = Rotation.from_matrix(flight.T_w_b[0, :3, :3]).as_euler("ZYX")[0]
    R = Rotation.from_euler("z", -yaw0).as_matrix() @ flight.T_w_b[index, :3, :3]
    roll, pitch, yaw = sample.rpy_rad
    np.testing.assert_allclose(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), R, atol=1e-3)
    assert sample.height_m == pytest.approx(flight.T_w_b[index, 2, 3] - flight.T_w_b[0, 2, 3], abs=1e-3)
    assert sample.tof_m == pytest.approx(flight.T_w_b[index, 2, 3], abs=1e-3)
    p = flight.T_w_b[:, :3, 3]
    acceleration = (p[index + 3] - 2 * p[index] + p[index - 3]) / 0.1**2  # three frames are a tenth of a second
    force = flight.T_w_b[index, :3, :3].T @ (acceleration + [0.0, 0.0, 9.81])
    np.testing.assert_allclose(sample.acceleration_m_s2, force, atol=0.02)


def test_sdk_rows_have_the_signs_and_units_of_a_tello():
    """Forward, up and turning left from power-on, worked out by hand: 0.5 m/s, 0.2 m/s, 10 deg/s."""
    t = np.arange(0, 4, 1 / 30)
    T_w_b = np.tile(np.eye(4), (len(t), 1, 1))
    heading = 0.7
    T_w_b[:, :3, :3] = Rotation.from_euler("z", heading + np.deg2rad(10) * t[:, None]).as_matrix()
    T_w_b[:, :3, 3] = t[:, None] * [0.5 * np.cos(heading), 0.5 * np.sin(heading), 0.2]
    T_b_c = camera_on_body()
    log = simulate(np.random.default_rng(0), t, T_w_b @ T_b_c, T_b_c, faults=replace(EXACT, quantise=True))
    row = dict(zip(FIELDS, log.rows[20], strict=True))  # two seconds in
    assert (row["vgx"], row["vgy"], row["vgz"]) == (5, 0, -2)
    assert (row["pitch"], row["roll"], row["yaw"]) == (0, 0, -20)
    assert (row["tof"], row["h"], row["bat"]) == (50, 40, 87)
    assert (row["agx"], row["agy"], row["agz"]) == (0, 0, -1000)
    assert np.all(log.rows[:, :8] == np.rint(log.rows[:, :8]))


def test_video_delay_stamps_telemetry_earlier(flight):
    logs = [simulated(flight, replace(EXACT, video_delay_s=d)) for d in (0.0, 0.5)]
    np.testing.assert_allclose(logs[0].stamps_s - logs[1].stamps_s, 0.5)
    np.testing.assert_array_equal(logs[0].rows, logs[1].rows)


def test_drift_grows_as_the_battery_drains():
    t = np.arange(0, 60, 0.1)
    T_b_c = camera_on_body()
    T_w_c = np.tile(T_b_c, (len(t), 1, 1))
    spread = []
    for battery in (1.0, 0.15):
        faults = replace(EXACT, velocity_walk=0.008, battery_start=battery)
        ends = []
        for seed in range(40):
            v = 0.1 * simulate(np.random.default_rng(seed), t, T_w_c, T_b_c, faults=faults).rows[:, FIELDS.index("vgx")]
            ends.append(v.sum() * 0.1)
        spread.append(np.std(ends))
    assert spread[1] > 1.8 * spread[0]


def test_loss_drops_packets(flight):
    log = simulated(flight, TelemetryFaults(loss=0.3))
    assert 0.6 < len(log.stamps_s) / len(simulated(flight).stamps_s) < 0.8
    assert np.all(np.diff(log.stamps_s) >= 0)


def test_telemetry_needs_increasing_stamps(flight):
    with pytest.raises(ValueError, match="increasing stamps"):
        simulate(np.random.default_rng(0), flight.stamps_s[:3], flight.T_w_c[:3], flight.T_b_c)
    with pytest.raises(ValueError, match="increasing stamps"):
        simulate(np.random.default_rng(0), np.zeros(900), flight.T_w_c, flight.T_b_c)


def test_csv_reader_agrees_with_our_own_conversion(tmp_path, flight):
    log = simulated(flight, TelemetryFaults())
    log.write(tmp_path / "telemetry.csv")
    for read, own in zip(read_telemetry(tmp_path / "telemetry.csv")[0], log.samples(), strict=True):
        np.testing.assert_allclose(read.velocity_m_s, own.velocity_m_s, atol=1e-9)
        np.testing.assert_allclose(read.rpy_rad, own.rpy_rad, atol=1e-9)
        np.testing.assert_allclose(read.acceleration_m_s2, own.acceleration_m_s2, rtol=1e-3, atol=1e-6)
        assert read.height_m == pytest.approx(own.height_m)
        assert read.tof_m == pytest.approx(own.tof_m)
        assert read.battery == pytest.approx(own.battery)
