"""Simulated flights and their telemetry."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import load_camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.synthetic.flights.degrade import CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight, FlightPlan, fly
from edgeslam_torch.synthetic.flights.telemetry import EXACT, FIELDS, TelemetryFaults, simulate
from edgeslam_torch.synthetic.flights.writer import DEPTH_PER_METRE, write_flight
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.build import place

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


@pytest.fixture(scope="module")
def home() -> World:
    return place("furnished_room", np.random.default_rng(3))


@pytest.fixture(scope="module")
def flight(home: World) -> Flight:
    return fly(np.random.default_rng(3), home, 900)


def column(rows: np.ndarray, name: str) -> np.ndarray:
    return rows[:, FIELDS.index(name)]


@pytest.mark.parametrize("seed", range(3))
def test_flight_is_smooth_slow_and_clear_of_furniture(home: World, seed: int) -> None:
    plan = FlightPlan()
    flight = fly(np.random.default_rng(seed), home, 900, plan=plan)
    speed = np.linalg.norm(flight.velocity_w, axis=1)
    assert np.median(speed) > 0.25
    assert speed.max() < 1.0
    yaw = np.unwrap(Rotation.from_matrix(flight.T_w_b[:, :3, :3]).as_euler("ZYX")[:, 0])
    assert np.abs(np.gradient(yaw, flight.stamps_s)).max() < np.deg2rad(60)
    jerk = np.diff(flight.T_w_b[:, :3, 3], 3, axis=0) * 30**3
    assert np.abs(jerk).max() < 30.0  # 1 m/s from one frame to the next would show 900
    flying = flight.T_w_b[:, 2, 3] > 0.9
    assert home.clearance(flight.T_w_b[flying, :3, 3]).min() > plan.clearance_m - 0.1


def test_flight_starts_low_and_climbs(flight: Flight) -> None:
    z = flight.T_w_b[:, 2, 3]
    assert z[0] == pytest.approx(0.4, abs=0.02)
    assert 0.7 < z[150:].min() < z.max() < 1.7


def test_flight_velocity_is_the_derivative_of_position(flight: Flight) -> None:
    difference = np.gradient(flight.T_w_b[:, :3, 3], flight.stamps_s, axis=0)
    np.testing.assert_allclose(difference[1:-1], flight.velocity_w[1:-1], atol=2e-3)


def test_twist_carries_one_pose_to_the_next(flight: Flight) -> None:
    k, dt = 400, 2 / 30
    there = flight.T_w_c[k - 1] @ se3.exp(flight.twist_c(k) * dt)
    np.testing.assert_allclose(there, flight.T_w_c[k + 1], atol=1e-9)


def test_flight_of_ten_thousand_frames_stays_in_the_room(home: World) -> None:
    flight = fly(np.random.default_rng(0), home, 10_000)
    assert np.all(flight.T_w_b[:, :3, 3] > home.bounds_w[0])
    assert np.all(flight.T_w_b[:, :3, 3] < home.bounds_w[1])
    assert np.linalg.norm(np.diff(flight.T_w_b[:, :3, 3], axis=0), axis=1).sum() > 60.0


def test_same_seed_gives_the_same_flight(home: World) -> None:
    a, b = (fly(np.random.default_rng(8), home, 120) for _ in range(2))
    assert a.T_w_b.tobytes() == b.T_w_b.tobytes()


def test_flight_without_air_is_refused(home: World) -> None:
    with pytest.raises(ValueError, match="free air"):
        fly(np.random.default_rng(0), home, 30, plan=FlightPlan(clearance_m=4.0))


def test_integrated_exact_velocity_reproduces_the_path(flight: Flight) -> None:
    log = simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=EXACT)
    samples = log.samples()
    v = np.stack([s.velocity_m_s for s in samples])
    moved = np.cumsum(v[1:], axis=0) * 0.1  # each is the mean over the tenth of a second around its stamp
    yaw0 = Rotation.from_matrix(flight.T_w_b[0, :3, :3]).as_euler("ZYX")[0]
    truth = Rotation.from_euler("z", -yaw0).apply(flight.T_w_b[:, :3, 3] - flight.T_w_b[0, :3, 3])
    half = np.stack([np.interp(log.stamps_s[1:] + 0.05, flight.stamps_s, truth[:, k]) for k in range(3)], axis=1)
    start = np.array([np.interp(0.05, flight.stamps_s, truth[:, k]) for k in range(3)])
    np.testing.assert_allclose(moved[:-1], half[:-1] - start, atol=5e-3)


def test_exact_attitude_height_and_force_follow_the_pose(flight: Flight) -> None:
    log = simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=EXACT, floor_m=0.0)
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


def test_sdk_rows_have_the_signs_and_units_of_a_tello() -> None:
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


def test_video_delay_stamps_telemetry_earlier(flight: Flight) -> None:
    logs = [
        simulate(
            np.random.default_rng(0),
            flight.stamps_s,
            flight.T_w_c,
            flight.T_b_c,
            faults=replace(EXACT, video_delay_s=d),
        )
        for d in (0.0, 0.5)
    ]
    np.testing.assert_allclose(logs[0].stamps_s - logs[1].stamps_s, 0.5)
    np.testing.assert_array_equal(logs[0].rows, logs[1].rows)


def test_loss_and_outage_drop_packets(flight: Flight) -> None:
    faults = TelemetryFaults(loss=0.3, outages_s=((10.0, 20.0),))
    log = simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c, faults=faults)
    assert not np.any((log.stamps_s >= 10.0) & (log.stamps_s < 20.0))
    assert 0.5 < len(log.stamps_s) / 200 < 0.9
    assert np.all(np.diff(log.stamps_s) >= 0)


def test_drift_grows_as_the_battery_drains() -> None:
    t = np.arange(0, 60, 0.1)
    T_b_c = camera_on_body()
    T_w_c = np.tile(T_b_c, (len(t), 1, 1))
    spread = []
    for battery in (1.0, 0.15):
        faults = replace(EXACT, velocity_walk=0.008, battery_start=battery)
        ends = []
        for seed in range(40):
            v = column(simulate(np.random.default_rng(seed), t, T_w_c, T_b_c, faults=faults).rows, "vgx") * 0.1
            ends.append(v.sum() * 0.1)
        spread.append(np.std(ends))
    assert spread[1] > 1.8 * spread[0]


def test_telemetry_needs_increasing_stamps(flight: Flight) -> None:
    with pytest.raises(ValueError, match="increasing stamps"):
        simulate(np.random.default_rng(0), flight.stamps_s[:3], flight.T_w_c[:3], flight.T_b_c)
    with pytest.raises(ValueError, match="increasing stamps"):
        simulate(np.random.default_rng(0), np.zeros(900), flight.T_w_c, flight.T_b_c)


def test_written_flight_is_read_back(tmp_path: Path, home: World, flight: Flight) -> None:
    short = Flight(flight.stamps_s[200:206], flight.T_w_b[200:206], flight.T_b_c, flight.velocity_w[200:206])
    log = simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c)
    write_flight(tmp_path / "f", home, short, CAMERA, telemetry=log, faults=CameraFaults(), depth_every=2)
    source = open_source(str(tmp_path / "f"))
    frames = list(source.frames())
    assert [f.stamp_s for f in frames] == pytest.approx(short.stamps_s.tolist(), abs=1e-6)
    assert len(source.telemetry) == len(log.stamps_s)
    assert source.groundtruth is not None
    assert pytest.approx(CAMERA.K) == load_camera(tmp_path / "f" / "camera.yaml").K
    view = render(home, CAMERA, short.T_w_c[2])
    depths = sorted((tmp_path / "f" / "depth").iterdir())
    assert len(depths) == 3
    stored = cv2.imread(str(depths[1]), cv2.IMREAD_UNCHANGED) / DEPTH_PER_METRE
    np.testing.assert_allclose(stored, view.depth_m, atol=0.5 / DEPTH_PER_METRE + 1e-6)
    written = read_trajectory(tmp_path / "f" / "groundtruth.txt")
    np.testing.assert_allclose(written.T_w_c[2], short.T_w_c[2], atol=1e-8)


def test_threads_do_not_change_the_images(tmp_path: Path, home: World, flight: Flight) -> None:
    short = Flight(flight.stamps_s[200:206], flight.T_w_b[200:206], flight.T_b_c, flight.velocity_w[200:206])
    for threads in (1, 3):
        write_flight(tmp_path / f"{threads}", home, short, CAMERA, faults=CameraFaults(), threads=threads)
    files = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*.*"))
    assert len(files) == 6 + 6 + 4
    assert all((tmp_path / "1" / f).read_bytes() == (tmp_path / "3" / f).read_bytes() for f in files)


def test_csv_reader_agrees_with_our_own_conversion(tmp_path: Path, flight: Flight) -> None:
    log = simulate(np.random.default_rng(0), flight.stamps_s, flight.T_w_c, flight.T_b_c)
    log.write(tmp_path / "telemetry.csv")
    from edgeslam_torch.readers.telemetry_csv import read_telemetry

    for read, own in zip(read_telemetry(tmp_path / "telemetry.csv")[0], log.samples(), strict=True):
        np.testing.assert_allclose(read.velocity_m_s, own.velocity_m_s, atol=1e-9)
        np.testing.assert_allclose(read.rpy_rad, own.rpy_rad, atol=1e-9)
        np.testing.assert_allclose(read.acceleration_m_s2, own.acceleration_m_s2, rtol=1e-3, atol=1e-6)
        assert read.height_m == pytest.approx(own.height_m)
        assert read.tof_m == pytest.approx(own.tof_m)
        assert read.battery == pytest.approx(own.battery)


@pytest.mark.data
@pytest.mark.parametrize("name", ["tum_fr1_xyz", "7scenes_redkitchen", "euroc_v1_01"])
def test_telemetry_of_real_ground_truth_is_plausible(data_dir: Path, name: str) -> None:
    truth = open_dataset(data_dir / name).truth
    T_b_c = camera_on_body() if name != "euroc_v1_01" else np.eye(4)
    log = simulate(np.random.default_rng(0), truth.stamps_s, truth.T_w_c, T_b_c)
    v = np.stack([s.velocity_m_s for s in log.samples()])
    assert len(v) == pytest.approx(10 * (truth.stamps_s[-1] - truth.stamps_s[0]), abs=2)
    assert 0.05 < np.median(np.linalg.norm(v, axis=1)) < 1.0
    assert np.abs(v).max() < 3.5
    T_w_b = truth.T_w_c @ se3.inverse(T_b_c)
    yaw0 = Rotation.from_matrix(T_w_b[0, :3, :3]).as_euler("ZYX")[0]
    moved = Rotation.from_euler("z", -yaw0).apply(T_w_b[:, :3, 3] - T_w_b[0, :3, 3])
    at = log.stamps_s + 0.5
    there = np.stack([np.interp(at, truth.stamps_s, moved[:, k]) for k in range(3)], axis=1)
    drift = np.linalg.norm(np.cumsum(v, axis=0) * 0.1 - there, axis=1)
    assert drift.max() < 0.05 + 0.02 * (truth.stamps_s[-1] - truth.stamps_s[0])  # a few cm/s of bias
