"""The filter on a real MAV's motion (EuRoC V1_01_easy): errors, and whether its covariance is true."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import chdtri

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.delayed import BufferedEkf, PoseSigma
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, rpy_from_matrix, wrapped
from edgeslam_torch.readers.telemetry_csv import read_telemetry
from edgeslam_torch.types import FloatArray, TelemetrySample

SIGMA_T, SIGMA_R = 0.005, np.deg2rad(0.1)
"""Stated noise of one visual increment of 0.2 s."""
VIDEO_DELAY_S = 0.5
DURATION_S = 50.0


@dataclass(frozen=True)
class Flight:
    stamps_s: FloatArray
    p: FloatArray
    R: Rotation

    def pose(self, t):
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3] = Slerp(self.stamps_s, self.R)(t).as_matrix()
        T[:, :3, 3] = np.stack([np.interp(t, self.stamps_s, self.p[:, k]) for k in range(3)], axis=1)
        return T


@pytest.fixture(scope="module")
def flight(data_dir: Path) -> Flight:
    table = np.loadtxt(data_dir / "euroc_v1_01" / "groundtruth.txt")
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    stamps = table[:, 0] - table[0, 0]
    axes = Rotation.from_matrix(np.column_stack([[0, 0, 1.0], [0, -1.0, 0], [1.0, 0, 0]]))  # body axes in the IMU's
    return Flight(stamps, table[:, 1:4], Rotation.from_quat(table[:, 4:8]) * axes)


@dataclass(frozen=True)
class Scene:
    telemetry: list[TelemetrySample]
    visual: list[tuple[float, float, FloatArray]]
    stamps_s: FloatArray
    T_w_b: FloatArray


def scene(flight: Flight, seed: int) -> Scene:
    """SDK telemetry (10 Hz, dm/s, degrees, bias that walks faster as the battery drains) and late visual increments."""
    rng = np.random.default_rng(seed)
    t = np.arange(20.0, 20.0 + DURATION_S, 0.1) + rng.uniform(0, 0.02)
    T = flight.pose(t)
    T_p_w = np.eye(4)  # world to the power-on frame: level, heading and origin of the first pose
    T_p_w[:3, :3] = matrix_from_rpy([0.0, 0.0, rpy_from_matrix(T[0, :3, :3])[2]]).T
    T_p_w[:3, 3] = -T_p_w[:3, :3] @ T[0, :3, 3]
    T = T_p_w @ T
    rpy = np.array([rpy_from_matrix(m[:3, :3]) for m in T])
    velocity = (flight.pose(t + 0.04)[:, :3, 3] - flight.pose(t - 0.04)[:, :3, 3]) / 0.08 @ T_p_w[:3, :3].T
    battery = np.round(1.0 - 0.6 * (t - t[0]) / DURATION_S, 2)
    walk = rng.standard_normal((len(t), 3)) * (0.005 * np.sqrt(0.1 * (2.0 - battery)))[:, None]
    bias = rng.normal(0, 0.03, 3) + np.cumsum(walk, axis=0)
    told = np.round(10 * (velocity + bias + rng.normal(0, 0.01, velocity.shape))) / 10
    angles = np.deg2rad(np.round(np.rad2deg(rpy) + rng.normal(0, 0.2, rpy.shape)))
    samples = [TelemetrySample(float(t[k]), told[k], angles[k], battery=float(battery[k])) for k in range(len(t))]
    seen = np.arange(t[0] + 0.033, t[-1] - 0.1, 0.2)
    T_seen = T_p_w @ flight.pose(seen)
    visual = []
    for i in range(1, len(seen)):
        step = se3.inverse(T_seen[i - 1]) @ T_seen[i]
        noisy = se3.exp(np.r_[0, 0, 0, rng.normal(0, SIGMA_R, 3)]) @ step
        noisy[:3, 3] = step[:3, 3] + rng.normal(0, SIGMA_T, 3)
        visual.append((float(seen[i - 1]), float(seen[i]), noisy))
    return Scene(samples, visual, t, T)


def fly(s: Scene) -> tuple[float, float]:
    """Mean square error of the position [m^2], and of position and attitude in sigmas (the NEES)."""
    ekf, errors, nees, fed = BufferedEkf(FusionConfig()), [], [], 0
    for k, sample in enumerate(s.telemetry):
        ekf.add_telemetry(sample)
        while fed < len(s.visual) and s.visual[fed][1] + VIDEO_DELAY_S <= sample.stamp_s:
            ekf.add_relative(*s.visual[fed], PoseSigma(SIGMA_T, SIGMA_R))
            fed += 1
        if k % 10 == 9:
            state = ekf.state_at(sample.stamp_s)
            errors.append(state.p_w - s.T_w_b[k, :3, 3])
            error = np.r_[errors[-1], wrapped(state.rpy_rad - rpy_from_matrix(s.T_w_b[k, :3, :3]))]
            nees.append(error @ np.linalg.solve(state.covariance, error))
    return float(np.mean(np.sum(np.square(errors), axis=1))), float(np.mean(nees))


def integrated(s: Scene) -> float:
    """Mean square error of telemetry alone [m^2]."""
    v = np.array([x.velocity_m_s for x in s.telemetry])
    p = np.vstack([np.zeros(3), np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(s.stamps_s)[:, None], axis=0)])
    return float(np.mean(np.sum((p - s.T_w_b[:, :3, 3]) ** 2, axis=1)))


@pytest.mark.data
@pytest.mark.slow
def test_mean_nees_over_25_seeds_is_inside_its_95_percent_band_and_telemetry_alone_is_three_times_worse(flight):
    """Chi-square of 6 x 25 degrees over 25: 4.72 to 7.43."""
    scenes = [scene(flight, seed) for seed in range(25)]
    square_m2, nees = np.mean([fly(s) for s in scenes], axis=0)
    low, high = chdtri(150, np.array([0.975, 0.025])) / 25
    assert low <= nees <= high
    assert square_m2 < np.mean([integrated(s) for s in scenes]) / 9


@pytest.mark.data
@pytest.mark.parametrize("name", ["flight_a", "flight_b"])
def test_real_tello_flights_run_through_the_filter(data_dir, name):
    samples = read_telemetry(data_dir / "tello_telemetry" / f"{name}.csv")[0]
    ekf = BufferedEkf(FusionConfig())
    for sample in samples[:1200]:
        ekf.add_telemetry(replace(sample))
    state = ekf.state_at(samples[1199].stamp_s)
    counts = ekf.statistics()
    assert np.isfinite(state.covariance).all()
    assert counts["attitude accepted"] > 0.97 * 1200
    assert counts.get("attitude refused", 0) + counts.get("attitude recovered", 0) < 0.03 * 1200
