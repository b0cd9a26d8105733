import numpy as np
import pytest

from edgeslam_torch.geometry.accelerometer_file import read_specific_force

MOUNT = """time_offset_s: 0.0
T_imu_cam:
- [0, -1, 0, 0]
- [1, 0, 0, 0]
- [0, 0, 1, 0]
- [0, 0, 0, 1]
"""


def test_kinect_readings_are_rotated_to_the_camera(tmp_path):
    (tmp_path / "accelerometer.txt").write_text("# timestamp ax ay az\n10.0 1 9 3\n10.01 1 9 3\n")
    force, said = read_specific_force([tmp_path])
    assert force.force_c[0].tolist() == [-1, -9, 3] and not said


def test_imu_readings_are_rotated_by_the_mount(tmp_path):
    (tmp_path / "imu.csv").write_text(
        "#timestamp [ns],wx,wy,wz,ax,ay,az\n1403638537577829376,0,0,0,9,1,0\n1403638537582829568,0,0,0,9,1,0\n"
    )
    (tmp_path / "imu.yaml").write_text(MOUNT)
    force, said = read_specific_force([tmp_path])
    assert force.force_c[0].tolist() == [1, -9, 0] and not said
    assert np.diff(force.stamps_s) == pytest.approx(0.005, abs=1e-3)


@pytest.mark.parametrize(
    "mount", ["", "T_imu_cam: 3\n", "T_imu_cam: [[1]]\n", MOUNT.replace("[1, 0, 0, 0]", "[2, 0, 0, 0]")]
)
def test_an_invalid_mount_is_reported_and_not_used(tmp_path, mount):
    (tmp_path / "imu.csv").write_text("0.0,0,0,0,9,1,0\n0.01,0,0,0,9,1,0\n")
    (tmp_path / "imu.yaml").write_text(mount)
    force, (said,) = read_specific_force([tmp_path])
    assert force is None and "imu.yaml" in said


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 a b c\n", "nan nan nan nan\n"])
def test_invalid_readings_are_reported_and_not_used(tmp_path, text):
    (tmp_path / "accelerometer.txt").write_text(text)
    force, (said,) = read_specific_force([tmp_path])
    assert force is None and "accelerometer.txt" in said


def test_without_an_accelerometer_there_is_no_warning(tmp_path):
    assert read_specific_force([tmp_path]) == (None, [])
