import csv
import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from fake_slam import FakeSlam

from edgeslam_torch.errors import OutputError
from edgeslam_torch.io.run_writer import RunWriter
from edgeslam_torch.types import Frame, Units


def outputs(count):
    slam = FakeSlam()
    image = np.full((4, 4), 9, np.uint8)
    return slam, [slam.step(Frame(i, 100.0 + i / 30, image)) for i in range(count)]


def test_rows_are_on_disk_before_the_next_frame(tmp_path):
    writer = RunWriter(tmp_path / "out")
    slam, frames = outputs(3)
    for i, output in enumerate(frames):
        writer.append(output, 2.5)
        table = np.loadtxt(tmp_path / "out" / "trajectory.txt", ndmin=2)
        assert table.shape == (i + 1, 8)
    assert table[2, 0] == pytest.approx(100.0 + 2 / 30, abs=1e-6)


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
    stamps, poses = slam.trajectory()
    assert (
        writer.finish(
            {"frames": 4, "sigma": math.inf},
            stamps,
            poses,
            slam.support(),
            slam.edge_map(),
            slam.anchors(),
            Units.METRES,
        )
        == []
    )
    writer.close()
    refined, online = np.loadtxt(tmp_path / "trajectory.txt"), np.loadtxt(tmp_path / "trajectory_online.txt")
    np.testing.assert_allclose(refined[:, 3] - online[:, 3], 1.0, atol=1e-8)
    assert json.loads((tmp_path / "summary.json").read_text()) == {"frames": 4, "sigma": None}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_an_older_run_is_replaced_and_other_files_are_kept(tmp_path):
    (tmp_path / "edge_map.ply").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    RunWriter(tmp_path).close()
    assert not (tmp_path / "edge_map.ply").exists()
    assert (tmp_path / "notes.txt").exists()


def test_source_folder_is_not_written_into(tmp_path):
    with pytest.raises(OutputError, match="is the source itself"):
        RunWriter(tmp_path, keep=[tmp_path])
    assert list(tmp_path.iterdir()) == []


def test_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write results there"):
        RunWriter(tmp_path / "file" / "out")


def test_full_disk_leaves_whole_lines_and_room_for_the_rest(tmp_path, monkeypatch):
    writer = RunWriter(tmp_path)
    slam, frames = outputs(5)
    for output in frames[:3]:
        assert writer.append(output, 1.0)

    class Full:
        """A file whose disk has room for twenty more bytes."""

        def __init__(self, file):
            self.file = file

        def write(self, data):
            return self.file.write(data[:20])

        def __getattr__(self, name):
            return getattr(self.file, name)

    writer._online._file = Full(writer._online._file)
    assert not writer.append(frames[3], 1.0)
    assert "no space left" in writer.failure
    assert not writer.append(frames[4], 1.0)
    assert np.loadtxt(tmp_path / "trajectory_online.txt").shape == (3, 8)
    stamps, poses = slam.trajectory()
    assert writer.finish({}, stamps, poses, slam.support(), slam.edge_map(), slam.anchors(), Units.METRES) == []
    assert np.loadtxt(tmp_path / "trajectory.txt").shape == (5, 8)


def test_result_that_cannot_be_written_is_named_and_the_others_are_written(tmp_path, monkeypatch):
    writer = RunWriter(tmp_path)
    slam, frames = outputs(2)
    replace = Path.replace

    def refuse(self, target):
        if Path(target).name == "edge_map.ply":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    stamps, poses = slam.trajectory()
    missing = writer.finish({}, stamps, poses, slam.support(), slam.edge_map(), slam.anchors(), Units.METRES)
    assert missing == ["edge_map.ply (No space left on device)"]
    assert "edge_map.ply" in writer.failure
    assert (tmp_path / "anchors.ply").exists()
