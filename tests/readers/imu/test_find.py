import numpy as np
import pytest

from edgeslam_torch.readers.imu.find import find_imu

MOUNT = """time_offset_s: 0.0
T_imu_cam:
- [0, -1, 0, 0]
- [1, 0, 0, 0]
- [0, 0, 1, 0]
- [0, 0, 0, 1]
"""


def test_kinect_readings_have_a_mount_and_no_gyroscope(tmp_path):
    (tmp_path / "accelerometer.txt").write_text("# timestamp ax ay az\n10.0 1 9 3\n10.01 1 9 3\n")
    model, readings, said = find_imu([tmp_path])
    assert (readings.acceleration_m_s2[0] @ model.T_imu_cam[:3, :3]).tolist() == [-1, -9, 3]
    assert not readings.has_gyroscope and not said


def test_readings_and_model_of_a_folder(tmp_path):
    (tmp_path / "imu.csv").write_text(
        "#timestamp [ns],wx,wy,wz,ax,ay,az\n1403638537577829376,1,2,3,9,1,0\n1403638537582829568,1,2,3,9,1,0\n"
    )
    (tmp_path / "imu.yaml").write_text(MOUNT)
    model, readings, said = find_imu([tmp_path])
    assert readings.angular_rate_rad_s[0].tolist() == [1, 2, 3]
    assert (readings.acceleration_m_s2[0] @ model.T_imu_cam[:3, :3]).tolist() == [1, -9, 0] and not said
    assert np.diff(readings.stamps_s) == pytest.approx(0.005, abs=1e-3)


@pytest.mark.parametrize("mount", ["", "T_imu_cam: 3\n", "T_imu_cam: [[1]]\n", MOUNT.replace("[1, 0,", "[2, 0,")])
def test_an_invalid_model_is_reported_and_not_used(tmp_path, mount):
    (tmp_path / "imu.csv").write_text("0.0,0,0,0,9,1,0\n0.01,0,0,0,9,1,0\n")
    (tmp_path / "imu.yaml").write_text(mount)
    model, readings, (said,) = find_imu([tmp_path])
    assert model is None and readings is None and "imu.yaml" in said


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 a b c\n", "nan nan nan nan\n"])
def test_invalid_readings_are_reported_and_not_used(tmp_path, text):
    (tmp_path / "accelerometer.txt").write_text(text)
    model, readings, (said,) = find_imu([tmp_path])
    assert model is None and readings is None and "accelerometer.txt" in said


def test_without_an_imu_there_is_no_warning(tmp_path):
    assert find_imu([tmp_path]) == (None, None, [])
