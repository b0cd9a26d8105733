"""Scale, vertical, mount and clock from a simulated IMU beside visual poses with correlated errors."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.sensors.imu import Imu
from edgeslam_torch.estimation.snapshot import Present
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.noise import IMU_YOUNG_S, VISUAL_MEMORY_S
from edgeslam_torch.synthetic.flights.imu import ADIS16448, MPU6050, mounted, simulate_imu

SCALE = 0.4
T_IMU_CAM = np.eye(4)
T_IMU_CAM[:3, :3] = Rotation.from_euler("xyz", [100.0, 5.0, 80.0], degrees=True).as_matrix()
T_IMU_CAM[:3, 3] = [0.05, -0.02, 0.03]
KINDS = {"ADIS16448": ADIS16448, "MPU-6050": MPU6050}
UNKNOWN = {"T_imu_cam": None, "time_offset_s": None}


@dataclass
class Flight:
    stamps_s: np.ndarray
    T_m_c: np.ndarray
    """Visual poses in the map."""
    readings: ImuReadings
    up_m: np.ndarray


def flight(kind: str, model: ImuModel, seed: int, seconds: float = 15.0) -> Flight:
    """A smooth random motion, a line at constant velocity or a stand, seen with errors of 6 mm and 1 mrad."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    hz, phase = rng.uniform(0.1, 0.5, (6, 3)), rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    waves = np.sin(2.0 * np.pi * hz[:, None] * t[None, :, None] + phase[:, None])
    moves = kind == "free"
    T_w_c = np.tile(np.eye(4), (len(t), 1, 1))
    T_w_c[:, :3, :3] = Rotation.from_rotvec(moves * 0.35 * waves[3:].sum(axis=0)).as_matrix() @ T_IMU_CAM[:3, :3]
    T_w_c[:, :3, 3] = moves * 0.5 * waves[:3].sum(axis=0) + (kind == "line") * np.outer(t, [0.8, 0.3, 0.1])
    readings = simulate_imu(rng, t, T_w_c, model)
    T = T_w_c[25:-35:5].copy()
    error = rng.standard_normal((len(T), 6))
    rho = math.exp(-0.1 / VISUAL_MEMORY_S)
    for k in range(1, len(T)):
        error[k] = rho * error[k - 1] + math.sqrt(1.0 - rho**2) * error[k]
    R_m_w = Rotation.random(rng=rng).as_matrix()
    T[:, :3, :3] = R_m_w @ T[:, :3, :3] @ Rotation.from_rotvec(1e-3 * error[:, :3]).as_matrix()
    T[:, :3, 3] = (T[:, :3, 3] + 0.006 * error[:, 3:]) @ R_m_w.T / SCALE
    return Flight(t[25:-35:5], T, readings, R_m_w[:, 2])


def fitted(seen: Flight, model: ImuModel) -> Imu:
    imu = Imu(model)
    imu.add([seen.readings])
    imu.fit(seen.stamps_s, seen.T_m_c)
    return imu


@pytest.mark.parametrize("kind", ["ADIS16448", pytest.param("MPU-6050", marks=pytest.mark.slow)])
def test_scale_and_vertical_with_honest_sigmas(kind: str) -> None:
    model = mounted(KINDS[kind], T_IMU_CAM)
    errors, sigmas, tilts = [], [], []
    for seed in range(6):
        seen = flight("free", model, seed)
        found = fitted(seen, model)
        assert found.scale is not None and found.up is not None
        assert found.warnings() == []
        errors.append(found.scale.log_scale - math.log(SCALE))
        sigmas.append(found.scale.sigma)
        tilts.append(math.acos(min(1.0, float(found.up[0] @ seen.up_m))) / (math.sqrt(2.0) * found.up[1]))
    z = np.array(errors) / sigmas
    assert np.median(np.abs(errors)) < 0.005
    assert np.max(np.abs(errors)) < 0.015
    assert np.sqrt(np.mean(z**2)) < 1.4
    assert np.sqrt(np.mean(np.square(tilts))) < 2.0


@pytest.mark.parametrize("seconds", [2.4, 3.2])
def test_the_scale_of_the_first_seconds_is_rough_and_says_so(seconds: float) -> None:
    """1.2 and 2 s of poses, in which a real map bends by a fifth."""
    model = mounted(ADIS16448, T_IMU_CAM)
    for seed in range(4):
        seen = flight("free", model, seed, seconds)
        bend = np.exp(np.linspace(-0.15, 0.15, len(seen.T_m_c)))
        seen.T_m_c[1:, :3, 3] = seen.T_m_c[0, :3, 3] + np.cumsum(
            np.diff(seen.T_m_c[:, :3, 3], axis=0) * bend[1:, None], axis=0
        )
        found = fitted(seen, model).scale
        if found is not None:
            assert found.sigma > 0.05
            assert abs(found.log_scale - math.log(SCALE)) < 2.5 * found.sigma


def test_a_map_that_bends_in_its_first_seconds_bends_no_scale() -> None:
    model, off = mounted(ADIS16448, T_IMU_CAM), []
    for seed in range(3):
        seen = flight("free", model, seed)
        step = np.diff(seen.T_m_c[:, :3, 3], axis=0)
        step[seen.stamps_s[1:] - seen.stamps_s[0] < IMU_YOUNG_S] *= math.exp(0.3)
        seen.T_m_c[1:, :3, 3] = seen.T_m_c[0, :3, 3] + np.cumsum(step, axis=0)
        found = fitted(seen, model).scale
        assert found is not None
        off.append(found.log_scale - math.log(SCALE))
    assert np.median(np.abs(off)) < 0.005
    assert np.max(np.abs(off)) < 0.015


@pytest.mark.parametrize(("motion", "kind"), [("static", "ADIS16448"), ("line", "MPU-6050")])
def test_without_acceleration_there_is_no_scale(motion: str, kind: str) -> None:
    model = mounted(KINDS[kind], T_IMU_CAM)
    for seed in range(2):
        found = fitted(flight(motion, model, seed), model)
        assert found.scale is None
        assert len(found.warnings()) == 1


@pytest.mark.parametrize("offset_s", [0.0, 0.03, -0.2])
def test_mount_and_clock_are_found(offset_s: float) -> None:
    for seed in range(2):
        seen = flight("free", mounted(ADIS16448, T_IMU_CAM, offset_s), seed)
        imu = fitted(seen, replace(ADIS16448, **UNKNOWN))
        found = imu.alignment
        assert found is not None
        assert imu.statistics()["imu time offset s"] == found.offset_s
        assert found.offset_s == pytest.approx(offset_s, abs=1e-3)
        off = Rotation.from_matrix(T_IMU_CAM[:3, :3].T @ found.R_i_c).magnitude()
        assert math.degrees(off) < 0.3
        assert math.exp(found.log_scale) == pytest.approx(SCALE, rel=0.02)


def test_clipped_readings_leave_the_scale_honest() -> None:
    model = mounted(MPU6050, T_IMU_CAM)
    z = []
    for seed in range(4):
        seen = flight("free", model, seed)
        there = seen.readings
        felt = np.clip(there.acceleration_m_s2, -11.0, 11.0)
        seen.readings = ImuReadings(there.stamps_s, there.angular_rate_rad_s, felt)
        scale = fitted(seen, model).scale
        if scale is not None:
            z.append((scale.log_scale - math.log(SCALE)) / scale.sigma)
    assert len(z) >= 3
    assert np.max(np.abs(z)) < 3.0


def test_the_pose_between_frames_turns_with_the_gyroscope() -> None:
    """A third of a second after the last frame, with readings that came since and without."""
    model = mounted(ADIS16448, T_IMU_CAM)
    seen = flight("free", model, 0)
    last_s, now_s = seen.stamps_s[-4], float(seen.stamps_s[-1])
    fusion = MotionFusion(FusionConfig(), np.eye(4), imu=model)
    fusion.add_imu([seen.readings.between(-np.inf, last_s)])
    for stamp_s, T in zip(seen.stamps_s[:-3].tolist(), seen.T_m_c[:-3], strict=True):
        fusion.add_visual(stamp_s, T, 0.01, 0.001)
    present = Present(fusion.snapshot())
    felt = present.pose_at(now_s, (), [seen.readings.between(last_s, now_s)])
    guessed = present.pose_at(now_s)
    off = [Rotation.from_matrix(p.T_w_c[:3, :3].T @ seen.T_m_c[-1, :3, :3]).magnitude() for p in (felt, guessed)]
    assert (felt.source, guessed.source) == ("visual+imu", "visual")
    assert off[0] < min(0.005, 0.2 * off[1])


def test_a_piece_of_map_is_aligned_by_its_own_poses() -> None:
    """The camera leaves it for another one of another unit and heading, and returns at the end."""
    model = mounted(ADIS16448, T_IMU_CAM)
    seen = flight("free", model, 0)
    fusion = MotionFusion(FusionConfig(), np.eye(4), imu=model)
    fusion.add_imu([seen.readings])
    left_s, returned_s = seen.stamps_s[0] + 0.7 * np.ptp(seen.stamps_s), seen.stamps_s[-3]
    other = np.eye(4)
    other[:3, :3] = Rotation.from_rotvec([0.0, 0.5, 0.4]).as_matrix()
    for stamp_s, T in zip(seen.stamps_s.tolist(), seen.T_m_c, strict=True):
        away = left_s < stamp_s < returned_s
        fusion.enter(int(away))
        T_own = other @ T if away else T.copy()
        T_own[:3, 3] *= 3.0 if away else 1.0
        fusion.add_visual(stamp_s, T_own, 0.01, 0.001)
    fusion.revise(np.zeros(0), np.zeros((0, 4, 4)))
    assert fusion.scale().source == "imu"
    assert fusion.scale().value == pytest.approx(SCALE, rel=0.03)


FAULTS = {
    "rates, axes": lambda rate, felt, other: (rate[:, [1, 0, 2]], felt),
    "rates, degrees": lambda rate, felt, other: (np.rad2deg(rate), felt),
    "rates of another flight": lambda rate, felt, other: (other, felt),
    "accelerations in g": lambda rate, felt, other: (rate, felt / 9.81),
    "accelerations, axes": lambda rate, felt, other: (rate, felt[:, [1, 2, 0]]),
    "accelerations, sign": lambda rate, felt, other: (rate, -felt),
}


def test_a_larger_reading_shows_that_the_range_did_not_end_there() -> None:
    model = mounted(MPU6050, T_IMU_CAM)
    seen = flight("free", model, 1)
    t, rate = seen.readings.stamps_s, seen.readings.angular_rate_rad_s.copy()
    half = t < t[len(t) // 2]
    end = 0.5 * np.abs(rate[~half, 0]).max()
    rate[half, 0] = rate[half, 0].clip(-end, end)  # as a slow sensor that repeats its largest reading
    readings = ImuReadings(t, rate, seen.readings.acceleration_m_s2)
    middle_s = t[len(t) // 2]
    imu = Imu(model)
    imu.add([readings.between(-math.inf, middle_s)])
    early = seen.stamps_s < middle_s
    imu.fit(seen.stamps_s[early], seen.T_m_c[early])
    imu.add([readings.between(middle_s, math.inf)])
    imu.fit(seen.stamps_s, seen.T_m_c)
    fastest_s = t[~half][np.abs(rate[~half, 0]).argmax()]
    assert imu.turned(fastest_s - 0.05, fastest_s + 0.05) is not None


@pytest.mark.parametrize("fault", FAULTS)
def test_readings_that_contradict_the_images_are_not_used(fault: str) -> None:
    model = mounted(ADIS16448, T_IMU_CAM)
    other = flight("free", model, 9).readings.angular_rate_rad_s
    seen = flight("free", model, 0)
    there = seen.readings
    spoilt = FAULTS[fault](there.angular_rate_rad_s, there.acceleration_m_s2, other)
    seen.readings = ImuReadings(there.stamps_s, *spoilt)
    found = fitted(seen, model)
    assert found.scale is None and found.up is None
    assert len(found.warnings()) == 1
