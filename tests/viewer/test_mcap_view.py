"""A saved run, opened again by mcap-ros2-support, which shares no encoder with the writer."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.readers.pace import ReadingsCursor
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import Frame, FrameStatus, Health, PointCloud, PoseNow, ScaleEstimate, SlamOutput

pytest.importorskip("rosbags")
reader = pytest.importorskip("mcap_ros2.reader")
from edgeslam_torch.viewer.mcap_view import McapView, state_of  # noqa: E402

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, (-0.2, 0.0, 0.0, 0.0, 0.0))
BEGIN_S = 1.7e9
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Camera that looks along the world's x."""
EDGES = PointCloud(
    np.array([[1.0, 2, 3], [4, 5, 6]], np.float32),
    np.array([[255, 128, 1], [0, 0, 7]], np.uint8),
    np.array([0.1, 0.2], np.float32),
    np.array([3, 70000], np.int32),
)


def _output(index, status=FrameStatus.TRACKED, keyframe=False, **changes):
    T = AHEAD.copy()
    T[:3, 3] = 0.1 * index, 0.0, 1.0
    scale = ScaleEstimate(2.0, 0.1, "telemetry")
    t = BEGIN_S + 0.1 * index
    health = Health(t, "tracking", True, scale, telemetry_age_s=math.inf, battery=0.75, doubts=("no depth",))
    fields = {"reason": "", "matches": 40, "inliers": 30, "parallax_rad": 0.1, "keyframe": keyframe, "piece": 0}
    fields |= {"scale": scale, "metric": True, "revision": 0, "stage_ms": {"track": 4.0}, "health": health}
    return SlamOutput(index, t, T, status, **(fields | changes))


class _Slam:
    """Stands in for the system: a flight along x at 1 m/s."""

    def __init__(self):
        self.outputs = []

    def pose_now(self, stamp_s):
        variances = np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.003, 0.4, 0.5, 0.6])
        return PoseNow(stamp_s, AHEAD, np.array([1.0, 0.0, 0.0]), np.diag(variances), "visual", stamp_s, True, 0)

    def keyframes(self):
        return [SimpleNamespace(features=SimpleNamespace(uv=np.array([[10.0, 12.0], [60.0, 40.0]], np.float32)))]

    def trajectory(self):
        return np.array([o.stamp_s for o in self.outputs]), np.stack([o.T_w_c for o in self.outputs])

    def edge_map(self):
        return EDGES

    def anchors(self):
        return EDGES


def _picture(index):
    image = np.full((48, 64, 3), 200, np.uint8)
    image[10:30, 20:40] = 20 + index
    return Frame(index, BEGIN_S + 0.1 * index, image)


def _fly(path, count=6, readings=None):
    view, slam = McapView(CAMERA, path, readings), _Slam()
    for i in range(count):
        slam.outputs.append(_output(i, keyframe=i % 5 == 0))
        view.on_frame(_picture(i), slam.outputs[-1], slam)
    view.on_finish(slam)
    return slam


def _read(path):
    by_topic = {}
    for message in reader.read_ros2_messages(str(path)):
        by_topic.setdefault(message.channel.topic, []).append(message)
    return by_topic


def _seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "run.mcap"
    _fly(path)
    return _read(path)


def test_poses_are_those_of_the_run(flight):
    assert len(flight["/tf"]) == len(flight["/edgeslam/odometry"]) == 6
    (moved,) = flight["/tf"][3].ros_msg.transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "camera")
    assert _seconds(moved.header.stamp) == pytest.approx(BEGIN_S + 0.3)
    assert flight["/tf"][3].log_time_ns == pytest.approx((BEGIN_S + 0.3) * 1e9, abs=1e3)
    assert moved.transform.translation.x == pytest.approx(0.3)
    q = moved.transform.rotation
    # z of the camera (forward) is x of the world
    forward = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
    assert forward == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)


def test_odometry_has_velocity_in_the_cameras_axes_and_covariances(flight):
    odometry = flight["/edgeslam/odometry"][2].ros_msg
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "camera")
    v = odometry.twist.twist.linear
    assert (v.x, v.y, v.z) == pytest.approx((0.0, 0.0, 1.0))
    assert np.diag(np.reshape(odometry.pose.covariance, (6, 6))) == pytest.approx(
        [0.01, 0.02, 0.03, 0.001, 0.002, 0.003]
    )
    # world x, y, z become the camera's z, -x, -y
    assert np.diag(np.reshape(odometry.twist.covariance, (6, 6)))[:3] == pytest.approx([0.5, 0.6, 0.4])


def test_path_and_map_are_written_again_as_they_grow_and_at_the_end(flight):
    assert [len(m.ros_msg.poses) for m in flight["/edgeslam/path"]] == [1, 6]
    last = flight["/edgeslam/path"][-1].ros_msg.poses[-1]
    assert last.pose.position.x == pytest.approx(0.5)
    cloud = flight["/edgeslam/edge_map"][-1].ros_msg
    kinds = {7: "<f4", 6: "<u4"}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    rows = np.frombuffer(bytes(cloud.data), layout)
    assert rows["y"].tolist() == [2.0, 5.0] and rows["observations"].tolist() == [3, 70000]
    assert rows["rgb"].view("<u4").tolist() == [0xFF8001, 0x000007]
    assert (cloud.header.frame_id, cloud.width, cloud.row_step) == ("map", 2, 2 * cloud.point_step)


def test_pictures_are_undistorted_and_keyframes_have_features_drawn(flight):
    assert len(flight["/camera/image/compressed"]) == 6 and len(flight["/edgeslam/features/compressed"]) == 2
    shown = cv2.imdecode(np.frombuffer(bytes(flight["/camera/image/compressed"][5].ros_msg.data), np.uint8), -1)
    expected = CAMERA.undistort_image(_picture(5).image)
    assert np.abs(shown.astype(int) - expected).mean() < 3
    info = flight["/camera/camera_info"][0].ros_msg
    assert list(info.k) == CAMERA.K.ravel().tolist() and not any(info.d)
    drawn = cv2.imdecode(np.frombuffer(bytes(flight["/edgeslam/features/compressed"][1].ros_msg.data), np.uint8), -1)
    assert np.abs(drawn[9:16, 7:14].astype(int) - expected[9:16, 7:14]).max() > 40  # a keypoint at (10, 12)


def test_levels_follow_what_a_pilot_may_rely_on():
    lost = _output(0, FrameStatus.LOST, reason="3 inliers", metric=False)
    assert [level for _, level, _, _ in state_of(lost)] == [2, 1]
    assert state_of(lost)[0][2] == "lost (3 inliers)"
    assert state_of(_output(0, FrameStatus.PREDICTED))[0][1] == 1


def test_a_full_disk_ends_the_file_and_not_the_run(tmp_path, monkeypatch, caplog):
    view, slam = McapView(CAMERA, tmp_path / "a.mcap"), _Slam()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(view._file, "write", full)
    slam.outputs.append(_output(0))
    view.on_frame(_picture(0), slam.outputs[0], slam)
    view.on_finish(slam)
    assert "No space left" in caplog.text and list(tmp_path.iterdir()) == []
    assert "No space left" in view.failure, "the command ends with an error"


def test_readings_of_an_imu_are_saved_and_read_again(tmp_path, rng):
    stamps_s = BEGIN_S + 0.005 * np.arange(90)
    felt = ImuReadings(stamps_s, rng.standard_normal((90, 3)), rng.standard_normal((90, 3)) + [0, 0, 9.81])
    _fly(tmp_path / "a.mcap", readings=ReadingsCursor(SimpleNamespace(telemetry=[], imu=ImuModel(), imu_readings=felt)))
    read = open_source(tmp_path / "a.mcap").imu_readings
    assert read.stamps_s == pytest.approx(stamps_s, abs=1e-6)
    assert (read.angular_rate_rad_s == felt.angular_rate_rad_s).all()
    assert (read.acceleration_m_s2 == felt.acceleration_m_s2).all()
