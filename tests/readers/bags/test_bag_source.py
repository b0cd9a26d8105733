"""Bags written by others' libraries, read as sources."""

from pathlib import Path

import bag_files as bags
import cv2
import numpy as np
import pytest

from edgeslam_torch import cli
from edgeslam_torch.errors import CalibrationError, MissingPackageError, SourceError
from edgeslam_torch.readers.source import open_source

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
IMAGE, INFO, ODOM = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"
BEGIN_S = 1.7e9
WRITERS = {"a.mcap": bags.write_mcap, "a.bag": bags.write_ros1, "a": bags.write_ros2}


def _times(count, hz=30.0):
    return [BEGIN_S + i / hz for i in range(count)]


def _stamps(source):
    return np.array([frame.stamp_s for frame in source.frames()])


def _reasons(source):
    return "\n".join(f"{problem.file}: {problem.reason}" for problem in source.problems)


@pytest.mark.parametrize("name", WRITERS)
def test_each_format_gives_the_pictures_stamps_and_calibration_that_were_written(tmp_path, name):
    times = _times(5)
    info = ("/cam/camera_info", INFO, BEGIN_S, bags.camera_info((64, 48), 60.0, (0.05, -0.02, 0.001, -0.002, 0.01)))
    path = WRITERS[name](tmp_path / name, [info, *bags.pictures(times)])
    source = open_source(path)
    frames = list(source.frames())
    assert [frame.stamp_s for frame in frames] == pytest.approx(times, abs=1e-6)
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, bags.pixels(i))
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 60.0, 31.5, 23.5)
    assert camera.distortion == (0.05, -0.02, 0.001, -0.002, 0.01)
    assert source.kind == "bag" and source.length == 5 and source.warnings == []
    assert len(list(source.frames())) == 5  # a second time


def test_two_cameras_are_named_and_one_is_asked_for(tmp_path):
    left, right = bags.pictures(_times(3), "/cam0/image_raw"), bags.pictures(_times(2), "/cam1/image_raw")
    infos = [(f"/cam{i}/camera_info", INFO, BEGIN_S, bags.camera_info((64, 48), f)) for i, f in enumerate((60.0, 70.0))]
    path = bags.write_mcap(tmp_path / "a.mcap", bags.in_order(infos, left, right))
    with pytest.raises(SourceError, match=r"two cameras \(/cam0/image_raw, /cam1/image_raw\).*--topic /cam0/image_raw"):
        open_source(path)
    source = open_source(path, topics=["/cam1/image_raw"])
    assert source.length == 2 and source.camera.fx == 70.0


def test_raw_and_compressed_pictures_of_one_camera_are_one_camera(tmp_path):
    ok, png = cv2.imencode(".png", bags.pixels(0))
    assert ok
    small = [
        ("/cam/image_raw/compressed", "sensor_msgs/msg/CompressedImage", t, bags.compressed(t, png.tobytes(), "png"))
        for t in _times(3)
    ]
    path = bags.write_mcap(tmp_path / "a.mcap", bags.in_order(bags.pictures(_times(2)), small))
    assert open_source(path).length == 2
    chosen = open_source(path, topics=["image=/cam/image_raw/compressed"])
    np.testing.assert_array_equal(next(chosen.frames()).image, bags.pixels(0))


def test_depth_maps_are_no_camera(tmp_path):
    data = np.full((48, 64), 900, np.uint16)
    depth = [("/depth/image", IMAGE, t, bags.picture(t, data, "16UC1")) for t in _times(2)]
    name, kind = "/cam/depth/compressedDepth", "sensor_msgs/msg/CompressedImage"
    packed = [(name, kind, t, bags.compressed(t, b"abc", "16UC1; compressedDepth png")) for t in _times(2)]
    both = bags.write_mcap(tmp_path / "a.mcap", bags.in_order(bags.pictures(_times(3)), depth, packed))
    assert open_source(both).length == 3
    with pytest.raises(SourceError, match="depth maps"):
        open_source(both, topics=[name])
    only = bags.write_mcap(tmp_path / "b.mcap", bags.in_order(depth, packed))
    with pytest.raises(SourceError, match="depth maps only"):
        open_source(only)


@pytest.mark.parametrize(("sign", "words"), [(0.0, "are zero"), (-1.0, "run backwards")])
def test_header_stamps_that_tell_no_time_are_replaced_by_receipt_and_said(tmp_path, sign, words):
    received = _times(9)
    headers = [abs(sign) * 2 * received[0] + sign * t for t in received]
    source = open_source(bags.write_mcap(tmp_path / "a.mcap", bags.pictures(headers, received=received)))
    assert _stamps(source) == pytest.approx(received, abs=1e-6)
    assert words in _reasons(source)


def test_one_wild_stamp_and_a_clock_that_is_set_back_cost_no_picture(tmp_path):
    true = _times(20)
    wild = list(true)
    wild[7] = 0.0
    wild[12:] = [t - 3600.0 for t in true[12:]]
    path = bags.write_mcap(tmp_path / "a.mcap", bags.pictures(wild, received=[t + 0.01 for t in true]))
    source = open_source(path)
    assert _stamps(source) == pytest.approx(true, abs=1e-4)
    assert "2 header stamps jump" in _reasons(source)  # the wild one, and the first after the clock was set


def test_telemetry_of_another_clock_is_moved_to_the_pictures(tmp_path):
    times = _times(60)
    moving = [("/odom", ODOM, t, bags.odometry(t - 500.0, (t - BEGIN_S, 0, 0), 0.0, (1, 0, 0))) for t in times]
    source = open_source(bags.write_mcap(tmp_path / "a.mcap", bags.in_order(bags.pictures(times, late_s=0.0), moving)))
    assert source.telemetry[0].stamp_s == pytest.approx(times[0], abs=1e-3)
    assert "500 s apart" in _reasons(source)


@pytest.mark.parametrize("name", ["a.mcap", "a.bag"])
@pytest.mark.parametrize("keep", [0, 5, 40, 0.5, 0.98])
def test_a_truncated_file_is_refused_in_one_line_or_read_as_far_as_it_goes(tmp_path, name, keep):
    path = WRITERS[name](tmp_path / name, bags.pictures(_times(4)))
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    with pytest.raises(SourceError) as caught:
        list(open_source(path).frames())
    assert str(path.name) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("topic", ["/cam/image_rw", "odometry=/cam/image_raw", "odom=/cam/image_raw"])
def test_wrong_topics_are_refused(tmp_path, topic):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.pictures(_times(2)))
    with pytest.raises(SourceError, match=topic.split("=")[0]):
        open_source(path, topics=[topic])


def test_several_odometries_are_not_guessed_between(tmp_path):
    times = _times(40)
    two = [
        (name, ODOM, t, bags.odometry(t, (v * (t - BEGIN_S), 0, 0), 0.0, (v, 0, 0)))
        for t in times
        for name, v in (("/truth", 2.0), ("/wheels", 1.0))
    ]
    path = bags.write_mcap(tmp_path / "a.mcap", bags.in_order(bags.pictures(times), two))
    source = open_source(path)
    assert source.telemetry == [] and "choose with --topic odom=/truth" in _reasons(source)
    chosen = open_source(path, topics=["odom=/wheels"])
    assert chosen.telemetry[5].velocity_m_s == pytest.approx([1.0, 0.0, 0.0])
    assert open_source(path, topics=["odom=none"]).telemetry == []


def test_a_late_and_a_damaged_picture_cost_themselves_only(tmp_path):
    times = _times(6)
    times[3], times[4] = times[4], times[3]
    events = bags.pictures(times, received=_times(6))
    events[1][3]["data"] = b"short"
    source = open_source(bags.write_mcap(tmp_path / "a.mcap", events))
    assert len(_stamps(source)) == 4
    assert "does not increase" in _reasons(source) and "too few" in _reasons(source)


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.pictures(_times(2)))
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'edgeslam-torch\[bags\]'"):
        open_source(path)


def test_topics_are_listed_with_what_they_are_used_as(tmp_path, capsys):
    data = np.full((48, 64), 900, np.uint16)
    depth = [("/depth/image", IMAGE, t, bags.picture(t, data, "16UC1")) for t in _times(2)]
    odom = [("/odom", ODOM, t, bags.odometry(t, (0, 0, 0), 0.0, (1, 0, 0))) for t in _times(31)]
    path = bags.write_mcap(tmp_path / "a.mcap", bags.in_order(bags.pictures(_times(31), late_s=0.0), depth, odom))
    assert cli.main(["topics", str(path)]) == 0
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()[2:]}
    assert lines["/cam/image_raw"][1:] == ["sensor_msgs/Image", "31", "30.0", "image"]
    assert lines["/odom"][-1] == "odom"
    assert "".join(lines["/depth/image"][4:]) == "notused(depthmap,16UC1)"
    assert cli.main(["topics", str(tmp_path / "no.bag")]) == 1
    assert "no such file" in capsys.readouterr().err


def test_missing_and_empty_camera_info_are_said(tmp_path):
    without = open_source(bags.write_mcap(tmp_path / "a.mcap", bags.pictures(_times(2))))
    assert "no calibration found" in without.warnings[0]
    info = ("/cam/camera_info", INFO, BEGIN_S, bags.camera_info((64, 48), 0.0))
    empty = open_source(bags.write_mcap(tmp_path / "b.mcap", [info, *bags.pictures(_times(2))]))
    assert "no calibration found" in empty.warnings[0] and "empty calibration" in _reasons(empty)


def test_a_folder_without_metadata_is_read_if_it_has_one_file(tmp_path):
    folder = bags.write_ros2(tmp_path / "a", bags.pictures(_times(3)))
    (folder / "metadata.yaml").unlink()
    assert open_source(folder).length == 3
    Path(folder / "b.mcap").write_bytes(b"")
    with pytest.raises(SourceError, match=r"no metadata.yaml beside a.db3, b.mcap"):
        open_source(folder)


def test_a_lens_that_ours_cannot_express_is_refused_in_one_line(tmp_path):
    wide = bags.camera_info((64, 48), 20.0, (-0.01, 0.02, -0.005, 0.001), "equidistant")
    path = bags.write_mcap(tmp_path / "a.mcap", [("/cam/camera_info", INFO, BEGIN_S, wide), *bags.pictures(_times(2))])
    with pytest.raises(CalibrationError, match="--camera FILE"):
        open_source(path)
    mine = tmp_path / "camera.yaml.mine"
    mine.write_text("width: 64\nheight: 48\nfx: 70\nfy: 70\ncx: 31\ncy: 23\n")
    assert open_source(path, camera=mine).camera.fx == 70
