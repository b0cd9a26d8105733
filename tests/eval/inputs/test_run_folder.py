"""A run's folder as evaluation reads it."""

import json

import pytest
from summaries import with_summary

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.run_folder import is_supported, open_run


def test_rows_are_those_of_the_poses_where_a_run_is_in_pieces(tmp_path):
    """Frames 2 and 3 are another piece's, in a file of its own."""
    whole = (0, 1, 4, 5)
    (tmp_path / "trajectory.txt").write_text("".join(f"{0.1 * i:.6f} {i} 0 0 0 0 0 1\n" for i in whole))
    rows = [f"{i},{0.1 * i:.6f},{int(i != 5)}" for i in range(6)]
    (tmp_path / "status.csv").write_text("index,stamp_s,supported\n" + "\n".join(rows) + "\n")
    run = open_run(tmp_path)
    assert [int(row["index"]) for row in run.pose_rows] == list(whole)
    assert [is_supported(row) for row in run.pose_rows] == [True, True, True, False]
    assert run.trusted_frames == 3
    assert len(run.status) == 6


@pytest.mark.parametrize(
    ("recording", "files"),
    [
        ("plain", ["plain/groundtruth.txt"]),
        ("sequences/00", ["sequences/00/times.txt", "sequences/00/image_0/000000.png", "poses/00.txt"]),
        ("mav0/cam0", ["mav0/cam0/data.csv", "mav0/cam0/data/0.png", "mav0/state_groundtruth_estimate0/data.csv"]),
    ],
)
def test_the_truth_of_a_recording_of_any_layout_is_the_runs_own(tmp_path, recording, files):
    for name in files:
        path = tmp_path / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("0,0.png\n" if path.name == "data.csv" else "0\n")
    run = tmp_path / "run"
    run.mkdir()
    (run / "trajectory.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    (run / "summary.json").write_text(json.dumps({"source": {"path": f"../data/{recording}"}}))
    assert open_run(run).own_truth == run / f"../data/{recording}"
    (tmp_path / "data" / files[-1]).unlink()
    assert open_run(run).own_truth is None


def test_source_beside_the_run_is_found_by_its_relative_name(run_folder, tmp_path):
    run_folder(tmp_path / "run", points=10)
    recording = tmp_path / "recording"
    recording.mkdir()
    names = ("../recording", str(recording), "x" * 5000, "\0")
    found = [open_run(with_summary(tmp_path / "run", source={"path": name})).source for name in names]
    assert found == [tmp_path / "run" / "../recording", recording, None, None]


@pytest.mark.parametrize("row", ["stamp_s,scale", "x,1", "1,x", "1,\xff", '1,"' + 200_000 * "x"])
def test_a_status_table_with_words_for_numbers_is_one_line(tmp_path, row):
    (tmp_path / "trajectory.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(3)))
    (tmp_path / "status.csv").write_text(f"stamp_s,scale\n0,\n{row}\n", encoding="latin-1")
    with pytest.raises(EvaluationError, match=r"status\.csv: not (the table of a run|a text file)"):
        open_run(tmp_path)
