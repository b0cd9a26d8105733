"""A flight on disk."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import load_camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.synthetic.flights.degrade import CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight
from edgeslam_torch.synthetic.flights.imu import MPU6050
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults
from edgeslam_torch.synthetic.flights.writer import DEPTH_PER_METRE, record_flight
from edgeslam_torch.synthetic.house.render import render

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


@pytest.fixture
def short(flight):
    """Twelve frames of it."""
    return Flight(flight.stamps_s[200:212], flight.T_w_b[200:212], flight.T_b_c, flight.velocity_w[200:212])


def test_written_flight_is_read_back(tmp_path, home, short):
    rng, folder = np.random.default_rng(0), tmp_path / "f"
    record_flight(folder, home, short, rng, CAMERA, TelemetryFaults(), CameraFaults(), seed=0, imu=MPU6050)
    source = open_source(str(folder))
    assert [f.stamp_s for f in source.frames()] == pytest.approx(short.stamps_s.tolist(), abs=1e-6)
    assert len(source.telemetry) == 4
    assert source.imu.T_imu_cam == pytest.approx(short.T_b_c) and source.imu.time_offset_s == 0.0
    assert source.imu.rate_hz == pytest.approx(200, rel=0.02) and len(source.imu_readings) == 74
    force_w = source.imu_readings.acceleration_m_s2.mean(axis=0) @ short.T_w_b[:, :3, :3].mean(axis=0).T
    assert force_w == pytest.approx([0.0, 0.0, 9.81], abs=1.0)
    assert pytest.approx(CAMERA.K) == load_camera(folder / "camera.yaml").K
    view = render(home, CAMERA, short.T_w_c[10])
    assert (folder / "depth.txt").read_text().splitlines()[2].startswith(f"{short.stamps_s[10]:.6f} ")
    depths = sorted((folder / "depth").iterdir())
    assert len(depths) == 2
    stored = cv2.imread(str(depths[1]), cv2.IMREAD_UNCHANGED) / DEPTH_PER_METRE
    np.testing.assert_allclose(stored, view.depth_m, atol=0.5 / DEPTH_PER_METRE + 1e-6)
    written = read_trajectory(folder / "groundtruth.txt")
    np.testing.assert_allclose(written.T_w_c[2], short.T_w_c[2], atol=1e-8)


def test_threads_do_not_change_the_images(tmp_path, home, short):
    for threads in (1, 3):
        rng, folder = np.random.default_rng(0), tmp_path / f"{threads}"
        record_flight(folder, home, short, rng, CAMERA, None, CameraFaults(), seed=0, threads=threads)
    files = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*.*"))
    assert len(files) == 12 + 2 + 4
    assert all((tmp_path / "1" / f).read_bytes() == (tmp_path / "3" / f).read_bytes() for f in files)
