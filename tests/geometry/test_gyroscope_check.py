from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.gyroscope_check import checked_against_rotation
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.synthetic.flights.imu import MPU6050, mounted, simulate_imu

STAMPS_S = np.arange(0.0, 12.0, 0.05)
T_IMU_CAM = se3.exp(np.array([0.02, 0.0, 0.0, 1.2, -1.1, 0.9]))
MODEL = mounted(MPU6050, T_IMU_CAM, 0.02)


def camera(seed, size=0.25):
    phase = np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    T = np.tile(np.eye(4), (len(STAMPS_S), 1, 1))
    angles = size * np.sin(STAMPS_S[:, None] * [1.1, 1.7, 0.8] + phase)
    T[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    return T


def checked(rng, model=MODEL, size=0.25, change=lambda rate: rate, seed=3):
    T_w_c = camera(3, size)
    readings = simulate_imu(rng, STAMPS_S, camera(seed, size), MODEL)
    noise = Rotation.from_rotvec(2e-3 * rng.standard_normal((len(T_w_c), 3))).as_matrix()
    readings = ImuReadings(readings.stamps_s, change(readings.angular_rate_rad_s), readings.acceleration_m_s2)
    return checked_against_rotation(readings, model, STAMPS_S, T_w_c[:, :3, :3] @ noise)


@pytest.mark.parametrize("model", [MODEL, replace(MODEL, T_imu_cam=None)])
def test_right_readings_have_no_fault(rng, model):
    check = checked(rng, model)
    assert check.known and not check.fault and check.misfit < 0.2


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"change": np.degrees}, "degrees"),
        ({"change": np.degrees, "model": replace(MODEL, T_imu_cam=None)}, "degrees"),
        ({"change": lambda rate: rate[:, [1, 0, 2]] * [1, -1, 1]}, "y, -x, z"),
        ({"change": lambda rate: rate * [1, -1, 1]}, "x, -y, z"),
        ({"change": lambda rate: rate[:, [1, 2, 0]]}, "y, z, x"),
        ({"change": lambda rate: rate[::-1].copy()}, "do not turn together"),
        ({"model": replace(MODEL, T_imu_cam=se3.inverse(T_IMU_CAM))}, "inverted"),
        ({"seed": 8}, "another flight"),
    ],
)
def test_the_fault_is_named(rng, wrong, words):
    check = checked(rng, **wrong)
    assert check.known and words in check.fault


def test_without_a_turn_nothing_is_known(rng):
    check = checked(rng, size=0.005)
    assert not check.known and not check.fault
