"""A flight on disk."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import load_camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.synthetic.flights.degrade import CameraFaults
from edgeslam_torch.synthetic.flights.flight import Flight, fly
from edgeslam_torch.synthetic.flights.paths import inspect
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults
from edgeslam_torch.synthetic.flights.writer import DEPTH_PER_METRE, record_flight
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.build import place

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


@pytest.fixture(scope="module")
def home():
    return place("furnished_room", np.random.default_rng(3))


@pytest.fixture(scope="module")
def flight(home):
    return fly(np.random.default_rng(3), home, 900, inspect)


def test_written_flight_is_read_back(tmp_path, home, flight):
    short = Flight(flight.stamps_s[200:212], flight.T_w_b[200:212], flight.T_b_c, flight.velocity_w[200:212])
    record_flight(
        tmp_path / "f", home, short, np.random.default_rng(0), CAMERA, TelemetryFaults(), CameraFaults(), seed=0
    )
    source = open_source(str(tmp_path / "f"))
    frames = list(source.frames())
    assert [f.stamp_s for f in frames] == pytest.approx(short.stamps_s.tolist(), abs=1e-6)
    assert len(source.telemetry) == 4
    assert source.groundtruth is not None
    assert pytest.approx(CAMERA.K) == load_camera(tmp_path / "f" / "camera.yaml").K
    view = render(home, CAMERA, short.T_w_c[10])
    depths = sorted((tmp_path / "f" / "depth").iterdir())
    assert len(depths) == 2
    stored = cv2.imread(str(depths[1]), cv2.IMREAD_UNCHANGED) / DEPTH_PER_METRE
    np.testing.assert_allclose(stored, view.depth_m, atol=0.5 / DEPTH_PER_METRE + 1e-6)
    written = read_trajectory(tmp_path / "f" / "groundtruth.txt")
    np.testing.assert_allclose(written.T_w_c[2], short.T_w_c[2], atol=1e-8)


def test_threads_do_not_change_the_images(tmp_path, home, flight):
    short = Flight(flight.stamps_s[200:206], flight.T_w_b[200:206], flight.T_b_c, flight.velocity_w[200:206])
    for threads in (1, 3):
        rng, folder = np.random.default_rng(0), tmp_path / f"{threads}"
        record_flight(folder, home, short, rng, CAMERA, None, CameraFaults(), seed=0, threads=threads)
    files = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*.*"))
    assert len(files) == 6 + 1 + 4
    assert all((tmp_path / "1" / f).read_bytes() == (tmp_path / "3" / f).read_bytes() for f in files)
