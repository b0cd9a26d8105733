"""Run folders as ``edgeslam run`` leaves them, made of a few formulas, for the tests of this folder."""

import csv
import json

import cv2
import numpy as np
import pytest

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, write_tum
from edgeslam_torch.types import PointCloud
from edgeslam_torch.writers.ply import write_ply

COLUMNS = (
    "index stamp_s status reason matches inliers parallax_deg keyframe scale scale_sigma scale_source "
    "features_ms track_ms"
)


def loop_trajectory(count=200, rate_hz=20.0, begin_s=100.0):
    """A camera on a rising wave inside a room, looking outwards and turning."""
    t = np.arange(count) / rate_hz
    yaw = 0.6 * np.sin(0.9 * t) + 0.35 * t
    forward = np.stack([np.cos(yaw), np.sin(yaw), 0.2 * np.sin(1.3 * t)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = right, np.cross(forward, right), forward
    T[:, :3, 3] = np.stack([1.5 * np.sin(0.5 * t), 1.1 * np.sin(0.8 * t + 1.0), 0.3 * np.cos(1.1 * t)], axis=1)
    return Trajectory(begin_s + t, T, "loop")


def make_run_folder(folder, points=2000, scale=1.0, rate_hz=20.0):
    """Fill ``folder`` with a run's files; returns a ground-truth file beside it."""
    rng = np.random.default_rng(0)
    (folder / "keyframes").mkdir(parents=True)
    truth = loop_trajectory(rate_hz=rate_hz)
    T = truth.T_w_c.copy()
    T[:, :3, 3] = (T[:, :3, 3] + rng.normal(0.0, 0.005, (len(T), 3))) / scale
    run = Trajectory(truth.stamps_s, T, "run")
    write_tum(run, folder / "trajectory.txt")
    write_tum(run, folder / "trajectory_online.txt")
    write_tum(truth, folder.parent / "truth.txt")
    walls = rng.uniform([-3, -3, -1], [3, 3, 1.5], (points, 3))
    walls[np.arange(points), rng.integers(0, 2, points)] = rng.choice([-3.0, 3.0], points)
    colour = np.clip(60 + 60 * (walls + 1.0), 0, 255).astype(np.uint8)
    sigma = rng.lognormal(-4.0, 0.7, points).astype(np.float32)
    cloud = PointCloud((walls / scale).astype(np.float32), colour, sigma, rng.geometric(0.2, points).astype(np.int32))
    write_ply(folder / "edge_map.ply", cloud)
    few = slice(0, points // 10)
    write_ply(folder / "anchors.ply", PointCloud(*(x[few] for x in (cloud.p_w, colour, sigma, cloud.observations))))
    _write_status(folder / "status.csv", run, rng)
    summary = {
        "source": "nowhere/box_room",
        "frames": len(run),
        "lost_events": 1,
        "fps": 24.5,
        "cpu_ms_per_frame": 33.1,
        "peak_rss_mb": 412.0,
        "scale": {"value": 1.0, "sigma": 0.03, "source": "depth", "units": "metres"},
        "up": {"source": "edges", "sigma_deg": 1.8},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "config.toml").write_text("[tracking]\nkeypoints = 1000\n")
    for k in range(3):
        image = np.full((120, 160, 3), 30, np.uint8)
        cv2.line(image, (10, 20 + 30 * k), (150, 40), (0, 160, 255), 1)
        cv2.imwrite(str(folder / "keyframes" / f"{run.stamps_s[40 * k]:.6f}.jpg"), image)
    return folder.parent / "truth.txt"


def _write_status(path, run, rng):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS.split())
        for i, stamp in enumerate(run.stamps_s):
            status, reason = ("initialised", "depth prior") if i < 2 else ("tracked", "")
            if 90 <= i < 94:
                status, reason = ("lost", "few matches (7) </script><b>") if i < 93 else ("relocalised", "keyframe 4")
            sigma = 0.03 + 0.3 * np.exp(-i / 30)
            ms = [f"{x:.2f}" for x in np.abs(rng.normal([6.0, 4.0], 1.0))]
            matches = int(300 + 40 * np.sin(i / 9))
            row = [i, f"{stamp:.6f}", status, reason, matches, int(0.8 * matches), 1.2, int(i % 10 == 0)]
            writer.writerow([*row, 1.0, f"{sigma:.4f}", "depth", *ms])


@pytest.fixture(scope="session")
def run_folder():
    """`make_run_folder`, for tests that need one."""
    return make_run_folder


@pytest.fixture(scope="session")
def loop():
    """`loop_trajectory` with its defaults."""
    return loop_trajectory()
