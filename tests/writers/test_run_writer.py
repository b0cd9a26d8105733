import csv
import errno
import json
import math
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from fake_slam import FakeSlam
from full_disk import FullDisk

from edgeslam_torch.errors import OutputError
from edgeslam_torch.types import Frame, Support, Units
from edgeslam_torch.writers.run_writer import OUTPUTS, RunWriter


def outputs(count):
    slam = FakeSlam()
    image = np.full((4, 4), 9, np.uint8)
    return slam, [slam.step(Frame(i, 100.0 + i / 30, image)) for i in range(count)]


def finished(writer, slam, summary, support=None):
    """What could not be written."""
    support = support or slam.support()
    return writer.finish(summary, *slam.trajectory(), support, slam.edge_map(), slam.anchors(), Units.METRES)


def test_status_table_widens_for_a_stage_that_comes_later(tmp_path):
    writer = RunWriter(tmp_path)
    slam, frames = outputs(8)
    for output in [*frames[1:5], frames[0]]:
        writer.append(output, 1.0)
    writer.append(frames[6], 1.0)
    writer.close()
    rows = list(csv.DictReader((tmp_path / "status.csv").open()))
    assert len(rows) == 6
    assert [row["mapping_ms"] for row in rows] == ["", "", "", "", "5.000", ""]
    assert rows[0]["status"] == "tracked"
    assert float(rows[0]["parallax_deg"]) == pytest.approx(math.degrees(0.01), abs=1e-4)
    assert rows[4]["keyframe"] == "1"


def test_end_result(tmp_path):
    writer = RunWriter(tmp_path)
    slam, frames = outputs(4)
    for output in frames:
        writer.append(output, 1.0)
    assert finished(writer, slam, {"frames": 4, "sigma": math.inf}) == []
    writer.close()
    refined, online = np.loadtxt(tmp_path / "trajectory.txt"), np.loadtxt(tmp_path / "trajectory_online.txt")
    np.testing.assert_allclose(refined[:, 3] - online[:, 3], 1.0, atol=1e-8)
    assert json.loads((tmp_path / "summary.json").read_text()) == {"frames": 4, "sigma": None}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_pieces_that_were_never_joined_have_files_of_their_own(tmp_path):
    """Frames 0 to 2 and 5 in the largest piece, 3 and 4 in another; 6 belongs to one that never stood."""
    piece, supported = np.array([0, 0, 0, 1, 1, 0, 2]), np.array([1, 1, 1, 1, 1, 0, 0], bool)
    (tmp_path / "trajectory_piece_7.txt").write_text("an older run's")
    slam, frames = outputs(7)
    with closing(RunWriter(tmp_path)) as writer:
        for output in frames:
            writer.append(output, 1.0)
        support = Support(piece, supported)
        assert (support.largest(), support.others()) == (0, [1])
        finished(writer, slam, {}, support)
    stamps, poses = slam.trajectory()
    whole, other = (np.loadtxt(tmp_path / name) for name in ("trajectory.txt", "trajectory_piece_1.txt"))
    np.testing.assert_allclose(whole[:, 0], stamps[[0, 1, 2, 5, 6]], atol=1e-6)
    np.testing.assert_allclose(other[:, 0], stamps[3:5], atol=1e-6)
    np.testing.assert_allclose(other[:, 1:4], poses[3:5, :3, 3], atol=1e-8)
    assert sorted(p.name for p in tmp_path.glob("trajectory_piece*")) == ["trajectory_piece_1.txt"]


def leave_run(folder, frames=2):
    """A folder as a run of so many frames leaves it."""
    slam, rows = outputs(frames)
    with closing(RunWriter(folder, config_toml="seed = 1\n")) as writer:
        for output in rows:
            writer.append(output, 1.0)
        finished(writer, slam, {"version": "0.1.0", "frames": frames, "statuses": {}})


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_an_older_run_stays_until_the_first_frame_is_there_and_other_files_stay_for_good(tmp_path):
    leave_run(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".trajectory.txt.part").write_text("left by a killed run")
    before = contents(tmp_path)
    RunWriter(tmp_path).close()
    RunWriter(tmp_path / "new").close()
    assert contents(tmp_path) == before and not (tmp_path / "new").exists()
    writer = RunWriter(tmp_path)
    writer.append(outputs(1)[1][0], 1.0)
    writer.close()
    left = {"trajectory.txt", "trajectory_online.txt", "status.csv", "config.toml", "notes.txt"}
    assert set(contents(tmp_path)) == left
    assert np.loadtxt(tmp_path / "trajectory.txt", ndmin=2).shape == (1, 8)


@pytest.mark.parametrize("name", [*OUTPUTS, "rgb.txt", "telemetry.csv", "sensor.yaml", "IMG_1.JPG", "flight.mp4"])
def test_a_folder_with_what_no_run_wrote_is_refused_and_left_alone(tmp_path, name):
    (tmp_path / name).write_text("version: mine\n")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=f"holds {name}, which no run wrote"):
        RunWriter(tmp_path)
    assert contents(tmp_path) == before


KILLED = """
import sys, time
from pathlib import Path
from test_run_writer import RunWriter, outputs
writer = RunWriter(Path(sys.argv[1]))
writer.append(outputs(1)[1][0], 1.0)
print("ready", flush=True)
time.sleep(60)
"""


def test_a_killed_run_leaves_no_lock_and_no_space_taken(tmp_path):
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path}) as killed:
        assert killed.stdout.readline() == "ready\n"
        with pytest.raises(OutputError, match=f"process {killed.pid} on"):
            RunWriter(tmp_path)
        killed.kill()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 10_000
    (tmp_path / ".reserve").write_bytes(bytes(99))  # as version 0.1 left it
    leave_run(tmp_path)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_full_disk_leaves_whole_lines_and_room_for_the_rest(tmp_path, monkeypatch):
    disk = FullDisk(monkeypatch, "trajectory_online.txt")
    writer = RunWriter(tmp_path)
    slam, frames = outputs(5)
    for i, output in enumerate(frames[:3], 1):
        assert writer.append(output, 1.0)
        assert np.loadtxt(tmp_path / "trajectory.txt", ndmin=2).shape == (i, 8), "on the disk before the next frame"

    disk.room = 20
    assert not writer.append(frames[3], 1.0)
    assert "No space left" in writer.failure
    assert not writer.append(frames[4], 1.0)
    assert np.loadtxt(tmp_path / "trajectory_online.txt").shape == (3, 8)
    assert finished(writer, slam, {}) == []
    assert np.loadtxt(tmp_path / "trajectory.txt").shape == (5, 8)


def test_a_recording_of_any_layout_is_refused_but_a_run_that_keeps_images_is_none(tmp_path, write_images):
    write_images(tmp_path / "kitti" / "image_0", ["000000.png"])
    (tmp_path / "kitti" / "times.txt").write_text("0\n")
    with pytest.raises(OutputError, match="holds a recording, which no run wrote"):
        RunWriter(tmp_path / "kitti")
    leave_run(tmp_path / "run")
    write_images(tmp_path / "run" / "images", ["0.000000.jpg"])
    RunWriter(tmp_path / "run").close()
    (tmp_path / "run" / "rgb").mkdir()
    with pytest.raises(OutputError, match="holds rgb, which no run wrote"):
        RunWriter(tmp_path / "run")


def test_a_run_is_not_replaced_from_a_file_within(tmp_path):
    """The camera that it is read with would be."""
    leave_run(tmp_path)
    (tmp_path / "run.mcap").touch()
    before = contents(tmp_path)
    with pytest.raises(OutputError):
        RunWriter(tmp_path, [tmp_path / "run.mcap"])
    assert contents(tmp_path) == before
    RunWriter(tmp_path, [tmp_path.parent / "other.mcap"]).close()


@pytest.mark.parametrize("left", [["status.csv", "config.toml"], ["summary.json", "camera.yaml"]])
def test_what_is_left_of_a_run_is_known_as_a_run(tmp_path, left):
    leave_run(tmp_path / "run")
    (tmp_path / "run" / "camera.yaml").write_text("")
    for path in (tmp_path / "run").iterdir():
        if path.name not in left:
            path.unlink()
    RunWriter(tmp_path / "run").close()


def test_one_run_at_a_time(tmp_path):
    first = RunWriter(tmp_path)
    with pytest.raises(OutputError, match=f"process {os.getpid()} on .* since 20.* writes a run there"):
        RunWriter(tmp_path)
    first.close()
    RunWriter(tmp_path).close()


def test_result_that_cannot_be_written_is_named_and_the_others_are_written(tmp_path, monkeypatch):
    writer = RunWriter(tmp_path)
    slam, frames = outputs(2)
    replace = Path.replace

    def refuse(self, target):
        if Path(target).name == "edge_map.ply":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    assert finished(writer, slam, {}) == ["edge_map.ply (No space left on device)"]
    assert "edge_map.ply" in writer.failure
    assert (tmp_path / "anchors.ply").exists()
