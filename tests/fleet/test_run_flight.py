"""The process of one flight, called in this one, with a stub of the SLAM system."""

import json
from functools import partial

import bag_files as bags
import numpy as np
import pytest
from fake_slam import FakeSlam

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.experiment import runner
from edgeslam_torch.fleet import run_flight
from edgeslam_torch.fleet.folder import BatchFolder, BatchSettings
from edgeslam_torch.fleet.manifest import read_manifests
from edgeslam_torch.run import run

FRAMES = 12
IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


@pytest.fixture
def flown(tmp_path, write_tum, monkeypatch):
    """Function that runs one recording as a batch's process would."""
    monkeypatch.setattr(run_flight, "run", partial(run, make_slam=lambda *_: FakeSlam()))

    def fly(recording, truth="", topic=""):
        manifest = tmp_path / "flights.csv"
        manifest.write_text(f"recording,name,camera,topic,truth\n{recording},one,,{topic},{truth}\n")
        folder = BatchFolder(tmp_path / "out")
        task = folder.task(read_manifests([str(manifest)])[0], BatchSettings(SlamConfig()))
        return folder, task, runner.main(task.prepare())

    return fly


def two_cameras(path, frames):
    """A bag of cameras, each with so many pictures and a calibration."""
    events = []
    for camera, count in frames.items():
        events.append((f"{camera}/camera_info", CAMERA_INFO, 100.0, bags.camera_info((64, 48), 60.0)))
        for i in range(count):
            picture = bags.picture(100.0 + 0.1 * i, np.full((48, 64, 3), 10 * i, np.uint8), "bgr8")
            events.append((f"{camera}/image_raw", IMAGE, 100.0 + 0.1 * i, picture))
    return bags.write_mcap(path, sorted(events, key=lambda event: event[2]))


def write_truth(path, scale=2.0):
    """The stub's path, `scale` times as long."""
    lines = [f"{100 + 0.1 * i:.6f} {scale * 0.01 * i} {0.001 * i * i} 1 0 0 0 1" for i in range(FRAMES)]
    path.write_text("\n".join(lines) + "\n")


def test_finished_flight_is_a_run_folder_with_report_picture_and_result(tmp_path, flown, write_tum):
    folder, task, code = flown(write_tum(tmp_path / "rec", FRAMES))
    assert code == 0
    made = folder.path / "flights" / "one"
    assert {"summary.json", "trajectory.txt", "report.html", "edge_map.ply"} <= {p.name for p in made.iterdir()}
    assert (folder.path / "pictures" / "one.jpg").is_file()
    assert list((folder.path / "work").iterdir()) == []
    found = task.result()
    assert (found["figures"]["frames"], found["figures"]["tracked"]) == (FRAMES, 1.0)
    assert "ate_m" not in found["figures"]
    source = json.loads((made / "summary.json").read_text())["source"]["path"]
    assert (made / source).resolve() == (tmp_path / "rec").resolve(), "the run still finds its recording"


def test_given_truth_comes_first(tmp_path, flown, write_tum):
    recording = write_tum(tmp_path / "rec", FRAMES)
    write_truth(recording / "groundtruth.txt", scale=9.0)
    write_truth(tmp_path / "truth.txt", scale=2.0)
    folder, task, _ = flown(recording, truth="truth.txt")
    figures = task.result()["figures"]
    assert 0 < figures["ate_m"] < 0.05
    assert figures["scale_error"] == pytest.approx(1.0, abs=0.3), "the truth is twice as long"


def test_broken_recording_says_why_in_its_last_line(tmp_path, flown, capsys):
    (tmp_path / "rec").mkdir()
    folder, task, code = flown(tmp_path / "rec")
    assert code == 1
    assert capsys.readouterr().err.strip().endswith("or a video")
    assert task.result() is None
    assert list((folder.path / "flights").iterdir()) == []


@pytest.mark.parametrize(("topic", "frames"), [("/cam0/image_raw", 12), ("/cam1/image_raw", 9)])
def test_a_bags_topic_is_the_tables(tmp_path, flown, topic, frames):
    pytest.importorskip("rosbags")
    pytest.importorskip("mcap_ros2")
    bag = two_cameras(tmp_path / "rec.mcap", {"/cam0": 12, "/cam1": 9})
    folder, task, code = flown(bag, topic=topic)
    assert code == 0
    assert task.result()["figures"]["frames"] == frames
