"""An IMU made along a recording."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.judge.simulated_imu import IMU_KINDS
from edgeslam_torch.eval.judge.simulated_telemetry import Drawn
from edgeslam_torch.geometry.gyroscope_check import checked_against_rotation

T_S = np.arange(0.0, 20.0, 0.05)


@pytest.fixture(scope="module")
def drawn():
    """A hand-held camera that swings and turns about."""
    T = np.tile(np.eye(4), (len(T_S), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(0.3 * np.sin(T_S[:, None] * [1.1, 1.7, 0.8])).as_matrix()
    T[:, :3, 3] = 0.5 * np.sin(T_S[:, None] * [1.3, 0.9, 2.0])
    return Drawn(Trajectory(T_S, T), T_S, 3)


@pytest.mark.parametrize("kind", IMU_KINDS)
def test_only_readings_that_do_not_turn_with_the_camera_are_faulty(drawn, kind):
    model, readings = IMU_KINDS[kind](drawn)
    known = replace(IMU_KINDS["mpu6050"](drawn)[0], time_offset_s=0.03 if kind.endswith("unknown") else 0.0)
    check = checked_against_rotation(readings, known, T_S, drawn.truth.T_w_c[:, :3, :3])
    assert (model.T_imu_cam is None) == kind.endswith("unknown")
    assert check.known and bool(check.fault) == (kind in ("degrees", "permuted", "other_flight"))


def test_faults_of_the_readings(drawn):
    assert np.diff(IMU_KINDS["gaps"](drawn)[1].stamps_s).max() > 0.4
    force = IMU_KINDS["clipped"](drawn)[1].acceleration_m_s2
    assert (np.abs(force) == np.abs(force).max()).sum() > 50
    again = IMU_KINDS["mpu6050"](drawn)[1]
    assert again.acceleration_m_s2.tobytes() == IMU_KINDS["mpu6050"](drawn)[1].acceleration_m_s2.tobytes()
