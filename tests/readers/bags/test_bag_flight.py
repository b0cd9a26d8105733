"""A simulated flight, once as a folder and once as a bag with ROS's telemetry: the same metres."""

import bag_files as bags
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch import cli
from edgeslam_torch.eval.metrics.run_score import evaluate_run
from edgeslam_torch.geometry.rotations import matrix_from_rpy
from edgeslam_torch.readers.source import open_source

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
LATE_S = 5.0
"""Receipt behind the headers: only the headers are right."""


def _as_bag(flight, path):
    source = open_source(flight)
    camera, events = source.camera, []
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    info = bags.camera_info((camera.width, camera.height), camera.fx, camera.distortion, k=k)
    events.append(("/cam/camera_info", "sensor_msgs/msg/CameraInfo", 0.0, info))
    for frame in source.frames():
        kind = "bgr8" if frame.image.ndim == 3 else "mono8"
        message = bags.picture(frame.stamp_s, frame.image, kind)
        events.append(("/cam/image_raw", "sensor_msgs/msg/Image", frame.stamp_s + LATE_S, message))
    position, last = np.zeros(3), source.telemetry[0].stamp_s
    for sample in source.telemetry:
        R = matrix_from_rpy(sample.rpy_rad)
        position = position + sample.velocity_m_s * (sample.stamp_s - last)
        last = sample.stamp_s
        message = bags.odometry(last, position, 0.0, R.T @ sample.velocity_m_s)
        x, y, z, w = (float(c) for c in Rotation.from_matrix(R).as_quat())
        message["pose"]["pose"]["orientation"] = {"x": x, "y": y, "z": z, "w": w}
        events.append(("/odom", "nav_msgs/msg/Odometry", last + LATE_S, message))
    return bags.write_mcap(path, sorted(events, key=lambda event: event[2]))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_odometry_of_a_bag_gives_the_metres_of_the_flight(tmp_path):
    assert cli.main(["demo", "--record-only", "--out", str(tmp_path / "sim")]) == 0
    flight = tmp_path / "sim" / "flight"
    bag = _as_bag(flight, tmp_path / "flight.mcap")
    saved = tmp_path / "run.mcap"
    out = tmp_path / "out"
    arguments = ["run", str(bag), "--out", str(out), "--depth", "none", "--no-report", "--save-mcap", str(saved)]
    assert cli.main(arguments) == 0
    score = evaluate_run(out, flight, judge_map=False)
    assert score.units == "metres" and abs(score.scale_error) < 0.02  # -0.004; the run's own sigma is 1.7 %
    assert score.ate_se3_m < 0.06
    found = open_source(saved)
    assert found.length == len(list(open_source(flight).frames()))
