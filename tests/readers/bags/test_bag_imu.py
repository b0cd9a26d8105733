"""IMU readings of bags."""

import bag_files as bags
import numpy as np
import pytest

from edgeslam_torch.readers.bags.bag import Topic
from edgeslam_torch.readers.bags.imu import choose_imu
from edgeslam_torch.readers.bags.recording import open_bag

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
BEGIN_S = 1.7e9
TIMES = BEGIN_S + 0.005 * np.arange(200)
IMAGE, IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"


def series(topic, rate=(0.1, 0.2, 0.3), force=(0.0, 1.0, 9.7), times=TIMES):
    for t in times:
        turned = {"angular_velocity": bags.xyz(rate)}
        yield topic, IMU, t, bags.imu(t, 0.0, force, known=False) | turned


def opened(tmp_path, *parts, topics=()):
    pictures = [("/cam0/image", IMAGE, t, bags.picture(t, np.zeros((8, 8), np.uint8), "mono8")) for t in TIMES[::40]]
    events = bags.in_order(pictures, *parts)
    return open_bag(bags.write_mcap(tmp_path / "a.mcap", events), topics)


def test_every_reading_of_the_imu_is_read(tmp_path):
    bag = opened(tmp_path, series("/imu"))
    readings, said = bag.imu()
    assert readings.stamps_s == pytest.approx(TIMES, abs=1e-6) and not said
    assert readings.angular_rate_rad_s[7].tolist() == [0.1, 0.2, 0.3]
    assert readings.acceleration_m_s2[7].tolist() == [0.0, 1.0, 9.7]
    assert len(bag.imu()[0]) == len(readings)


def test_gyroscope_and_accelerometer_in_two_topics_become_one(tmp_path):
    bag = opened(
        tmp_path,
        series("/cam0/gyro/sample", force=(0, 0, 0)),
        series("/cam0/accel/sample", rate=(0, 0, 0), times=TIMES[::3] + 0.001),
    )
    readings, _ = bag.imu()
    assert 190 < len(readings) <= 200
    assert readings.angular_rate_rad_s[7].tolist() == [0.1, 0.2, 0.3]
    assert readings.acceleration_m_s2 == pytest.approx(np.tile([0.0, 1.0, 9.7], (len(readings), 1)))


@pytest.mark.parametrize(
    ("counts", "used", "said"),
    [
        ({}, (), False),
        ({"/imu": 10}, ("/imu",), False),
        ({"/fcu/imu": 10, "/imu0": 9}, ("/fcu/imu",), True),
        ({"/cam0/imu": 5, "/fcu/imu": 10}, ("/cam0/imu",), True),
        ({"/cam0/accel/x": 5, "/cam0/gyro/x": 10, "/z": 90}, ("/cam0/gyro/x", "/cam0/accel/x"), True),
    ],
)
def test_the_imu_of_the_camera_is_chosen_and_said(counts, used, said):
    topics = [Topic(name, "sensor_msgs/Imu", count) for name, count in counts.items()]
    chosen, remark = choose_imu(topics, "/cam0/image")
    assert chosen == used and (remark is not None) == said


def test_none_is_read_when_the_user_says_so(tmp_path):
    assert opened(tmp_path, series("/imu"), topics=["imu=none"]).imu()[0] is None
