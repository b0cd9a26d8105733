"""Telemetry of bags: a drone that flies a circle of known velocity, reported in ROS's ways."""

import math

import bag_files as bags
import numpy as np
import pytest

from edgeslam_torch.readers.bags.recording import open_bag

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
BEGIN_S, RADIUS_M, RATE = 1.7e9, 2.0, 0.5
"""Flown forward, so that in body axes the velocity is always (1, 0, 0.1)."""
IMAGE, ODOM, IMU = "sensor_msgs/msg/Image", "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
TIMES = [BEGIN_S + 0.1 * i for i in range(100)]


def _yaw(t):
    return RATE * (t - BEGIN_S)


def _position(t):
    a = _yaw(t)
    return RADIUS_M * math.sin(a), RADIUS_M * (1 - math.cos(a)), 0.1 * (t - BEGIN_S)


def _world(t):
    a = _yaw(t)
    return np.array([math.cos(a), math.sin(a), 0.1])


BODY = (1.0, 0.0, 0.1)


def _read(tmp_path, *series, topics=()):
    pictures = [("/cam", IMAGE, t, bags.picture(t, np.zeros((8, 8), np.uint8), "mono8")) for t in TIMES[:2]]
    events = bags.in_order(pictures, *series)
    return open_bag(bags.write_mcap(tmp_path / "a.mcap", events), topics)


def _check(samples, most=1e-3):
    assert len(samples) > 80
    for sample in samples:
        assert sample.velocity_m_s == pytest.approx(_world(sample.stamp_s), abs=most)
        off = sample.rpy_rad - [0.0, 0.0, _yaw(sample.stamp_s)]
        assert np.abs((off + math.pi) % (2 * math.pi) - math.pi).max() < 1e-6


def _odometry(velocity, child="base_link"):
    return [("/odom", ODOM, t, bags.odometry(t, _position(t), _yaw(t), velocity(t), child)) for t in TIMES]


def test_odometry_in_body_axes_is_turned_to_the_world(tmp_path):
    bag = _read(tmp_path, _odometry(lambda t: BODY))
    _check(bag.telemetry)
    assert "taken from /odom (Odometry)" in bag.remarks[-1]


def test_positions_show_that_a_driver_breaks_the_definition(tmp_path):
    bag = _read(tmp_path, _odometry(_world))
    _check(bag.telemetry)
    assert any("axes of its world" in remark for remark in bag.remarks)
    bag = _read(tmp_path, _odometry(lambda t: BODY, "odom"))
    _check(bag.telemetry)
    assert any("axes of the body" in remark for remark in bag.remarks)


def test_odometry_without_velocities_is_differentiated(tmp_path):
    bag = _read(tmp_path, _odometry(lambda t: (0, 0, 0)))
    _check(bag.telemetry[1:-1], most=2e-3)
    assert any("made from positions" in remark for remark in bag.remarks)


def test_a_twist_is_turned_by_the_attitude_unless_it_is_in_the_world(tmp_path):
    turning = [("/imu", IMU, t, bags.imu(t, _yaw(t))) for t in TIMES]
    kind = "geometry_msgs/msg/TwistStamped"
    body = [("/vel", kind, t, bags.twist(t, BODY, "base_link")) for t in TIMES]
    bag = _read(tmp_path, turning, body)
    _check(bag.telemetry)
    assert bag.telemetry[5].acceleration_m_s2 == pytest.approx([0, 0, 9.81])
    world = [("/vel", kind, t, bags.twist(t, _world(t), "map")) for t in TIMES]
    _check(_read(tmp_path, turning, world).telemetry)
    alone = _read(tmp_path, body)
    assert alone.telemetry == [] and any("without any attitude" in remark for remark in alone.remarks)


def test_range_and_battery_join_the_velocities(tmp_path):
    def reading(t, metres):
        extra = {"radiation_type": 1, "field_of_view": 0.1, "min_range": 0.1, "max_range": 4.0, "range": metres}
        return ("/down", "sensor_msgs/msg/Range", t, {"header": bags.header(t)} | extra)

    ranges = [reading(t, 1.5 if t < BEGIN_S + 5 else math.inf) for t in TIMES]
    charge = {"header": bags.header(BEGIN_S), "voltage": 3.8, "percentage": 0.75}
    battery = [("/battery", "sensor_msgs/msg/BatteryState", BEGIN_S, charge)]
    samples = _read(tmp_path, _odometry(lambda t: BODY), ranges, battery).telemetry
    assert samples[10].tof_m == pytest.approx(1.5) and math.isnan(samples[-1].tof_m)
    assert [s.battery for s in samples if math.isfinite(s.battery)] == [0.75]


def test_the_tello_drivers_own_message_is_read_by_the_bags_definition(tmp_path):
    fields = {"pitch": 0, "roll": 0, "yaw": -30, "vgx": 10, "vgy": -5, "vgz": 2, "tof": 120, "h": 90, "bat": 80}
    fields |= {"baro": 50.5, "agx": 0.0, "agy": 0.0, "agz": -1000.0, "sdk": 1}
    text = "pitch:0;roll:0;yaw:-30;vgx:10;vgy:-5;vgz:2;tof:120;h:90;bat:80;baro:50.5;agx:0;agy:0;agz:-1000;"
    for raw in ("", text):
        data = [
            ("/flight_data", "tello_msgs/msg/FlightData", t, {"header": bags.header(t), "raw": raw} | fields)
            for t in TIMES
        ]
        sample = _read(tmp_path, data).telemetry[3]
        assert sample.velocity_m_s == pytest.approx([1.0, 0.5, -0.2])  # SDK: decimetres, y right, z down
        assert sample.rpy_rad[2] == pytest.approx(math.radians(30.0))
        assert (sample.tof_m, sample.height_m, sample.battery) == pytest.approx((1.2, 0.9, 0.8))
        assert sample.acceleration_m_s2[2] == pytest.approx(9.80665)


def test_odometry_whose_child_is_its_world_is_not_turned_nor_on_a_short_way(tmp_path):
    _check(_read(tmp_path, _odometry(_world, "odom")).telemetry)
    samples = _read(tmp_path, _odometry(_world, "odom")[:4]).telemetry
    assert samples[3].velocity_m_s == pytest.approx(_world(samples[3].stamp_s))


def test_a_fast_topic_is_thinned(tmp_path):
    fast = [BEGIN_S + 0.002 * i for i in range(2500)]
    odometry = [("/odom", ODOM, t, bags.odometry(t, _position(t), _yaw(t), BODY)) for t in fast]
    samples = _read(tmp_path, odometry).telemetry
    assert 90 < len(samples) < 115
    _check(samples)


def test_an_imu_that_measures_no_attitude_is_not_used(tmp_path):
    for known in (False, True):  # covariance -1, and a constant
        bag = _read(tmp_path, [("/imu", IMU, t, bags.imu(t, 0.3, known=known)) for t in TIMES])
        assert bag.telemetry == [] and any("holds no attitude" in remark for remark in bag.remarks)
