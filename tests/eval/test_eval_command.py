"""``edgeslam eval`` and ``report`` from the command line's side."""

import argparse
import json

import numpy as np
import pytest
from markdown_rows import row, rows
from summaries import with_summary

from edgeslam_torch.commands import report as report_command
from edgeslam_torch.commands import view as view_command
from edgeslam_torch.commands.judging import compare as compare_command
from edgeslam_torch.commands.judging import eval as eval_command
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.eval.metrics.run_score import evaluate_run
from edgeslam_torch.terminal.progress import Progress


def run(module, *words):
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    return int(module.main(parser.parse_args([str(w) for w in words])))


@pytest.mark.slow
def test_several_runs_give_an_aligned_table(run_folder, tmp_path, capsys):
    truth = run_folder(tmp_path / "a")
    run_folder(tmp_path / "b", scale=1.2)
    runs = [tmp_path / "a", tmp_path / "b", tmp_path / "a" / "trajectory_online.txt"]
    out = ("--json", tmp_path / "s.json", "--markdown", tmp_path / "s.md", "--plots", tmp_path / "plots")
    assert run(eval_command, *runs, "--groundtruth", truth, *out) == 0
    text = capsys.readouterr().out
    assert "median" not in text, "they may be of different systems"
    lines = text.split("\n\n")[1].splitlines()[-3:]
    assert [line.split()[0] for line in lines] == ["a", "b", "trajectory_online.txt"]
    markdown = (tmp_path / "s.md").read_text()
    assert {"a", "b"} <= {row[0] for row in rows(markdown)}
    records = json.loads((tmp_path / "s.json").read_text())
    assert [r["name"] for r in records] == ["a", "b", "trajectory_online.txt"]
    assert records[1]["scale_error"] == pytest.approx(0.2, abs=0.01)
    assert len(list((tmp_path / "plots").glob("*.png"))) == 4  # one a run, and all of them in one
    assert (tmp_path / "plots" / "trajectories.png").is_file()


def test_plots_are_not_added_to_pictures_of_others(run_folder, tmp_path):
    truth = run_folder(tmp_path / "a")
    words = (*[tmp_path / "a"] * 3, "--groundtruth", truth, "--plots")
    theirs = tmp_path / "pictures"
    theirs.mkdir()
    for i in range(5):
        (theirs / f"{i}.png").touch()
    with pytest.raises(EdgeSlamError):
        run(eval_command, *words, theirs)
    assert len(list(theirs.iterdir())) == 5
    for own in ("plots", "a/plots", "a"):
        for more in ([], ["--overwrite"]):
            assert run(eval_command, *words, tmp_path / own, *more) == 0


def own_recording(run_dir, truth):
    """The run says that it read a folder with ground truth."""
    folder = run_dir.parent / f"recording of {run_dir.name}"
    folder.mkdir()
    truth.rename(folder / "groundtruth.txt")
    with_summary(run_dir, source=str(folder))


def test_a_run_is_judged_by_the_truth_of_its_recording(run_folder, tmp_path, capsys):
    own_recording(tmp_path / "a", run_folder(tmp_path / "a"))
    assert run(eval_command, tmp_path / "a", "--markdown", "-", "--json", tmp_path / "s.json") == 0
    assert float(row(capsys.readouterr().out, "a")["ATE Sim(3) [m]"]) < 0.05
    json.loads((tmp_path / "s.json").read_text(), parse_constant=pytest.fail)
    with pytest.raises(EdgeSlamError, match="--groundtruth"):
        run(eval_command, tmp_path / "a" / "trajectory.txt")


def test_two_runs_are_compared(run_folder, tmp_path, capsys):
    own_recording(tmp_path / "a", run_folder(tmp_path / "a"))
    run_folder(tmp_path / "b", scale=1.2)
    assert run(compare_command, tmp_path / "a", tmp_path / "b" / "trajectory.txt") == 0
    scale = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("scale - 1"))
    assert float(scale.split()[-1].rstrip("%")) == pytest.approx(20, abs=1)
    own_recording(tmp_path / "b", tmp_path / "truth.txt")
    with pytest.raises(EdgeSlamError, match="different recordings"):
        run(compare_command, tmp_path / "a", tmp_path / "b")


def test_images_of_the_recording_count_and_stamp_a_file_that_has_no_stamps(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    dataset = tmp_path / "data"
    dataset.mkdir()
    (tmp_path / "truth.txt").rename(dataset / "groundtruth.txt")
    stamps = np.loadtxt(dataset / "groundtruth.txt")[:, 0]
    (dataset / "rgb.txt").write_text("".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in stamps))
    np.savetxt(tmp_path / "poses.txt", read_trajectory(tmp_path / "a").T_w_c[:, :3].reshape(-1, 12))
    score = evaluate_run(tmp_path / "poses.txt", dataset)
    assert score.matched == 200 and score.ate_sim3_m < 0.02
    assert "in order" in score.notes[0]
    score = evaluate_run(tmp_path / "a", dataset)
    assert score.coverage == pytest.approx(197 / 200)  # three lost
    assert score.with_pose == 1.0 and score.scale_inside_95 is True
    assert score.map is None and "depth" in score.map_note
    run_folder(tmp_path / "b", scale=1.2)  # says 3 %, is 20 % off
    assert evaluate_run(tmp_path / "b", dataset).scale_inside_95 is False


def test_report_of_a_bare_run_is_a_page_too(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    for name in ("status.csv", "summary.json", "edge_map.ply", "anchors.ply", "config.toml", "trajectory_online.txt"):
        (tmp_path / "a" / name).unlink()
    assert run(report_command, tmp_path / "a") == run(report_command, tmp_path / "a") == 0
    (tmp_path / "a" / "report.html").write_text("<title>precious</title>")
    with pytest.raises(EdgeSlamError):
        run(report_command, tmp_path / "a")
    assert (tmp_path / "a" / "report.html").read_text() == "<title>precious</title>"


def test_depth_maps_are_judged_by_name(tmp_path, capsys):
    for name, metres in (("ours", 1.1), ("truth", 1.0)):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "0001.npy", np.full((4, 6), metres))
    words = (tmp_path / "ours", "--groundtruth", tmp_path / "truth", "--depth-maps", "--json", tmp_path / "d.json")
    assert run(eval_command, *words) == 0
    assert row(capsys.readouterr().out, "metric")["AbsRel"] == "0.1000"
    assert json.loads((tmp_path / "d.json").read_text())[str(tmp_path / "ours")]["median_scaled"]["delta1"] == 1.0


def test_one_broken_run_does_not_hide_the_others(run_folder, tmp_path, capsys):
    truth = run_folder(tmp_path / "a")
    (tmp_path / "empty.txt").write_text("")
    assert run(eval_command, tmp_path / "empty.txt", tmp_path / "a", "--groundtruth", truth) == 1
    out, err = capsys.readouterr()
    assert "\na  " in out and "empty.txt" in err


def test_peers_are_compared_on_common_frames_and_told_apart(run_folder, tmp_path, capsys):
    truth = run_folder(tmp_path / "a")
    (tmp_path / "peer").mkdir()
    rows = (tmp_path / "a" / "trajectory.txt").read_text().splitlines(keepends=True)
    (tmp_path / "peer" / "a").write_text("".join(rows[81:]))
    assert run(eval_command, tmp_path / "a", tmp_path / "peer" / "a", "--groundtruth", truth, "--common-frames") == 0
    text = capsys.readouterr().out
    assert "On the 120 frames that all 2 have" in text
    common = [line.split()[:2] for line in text.split("On the 120")[1].splitlines()]
    assert [str(tmp_path / "peer" / "a"), "120"] in common and [str(tmp_path / "a"), "200"] in common


@pytest.mark.parametrize("what", ["missing", "file", "no ground truth"])
def test_wrong_folders_get_one_line(what, run_folder, tmp_path):
    truth = run_folder(tmp_path / "a")
    (tmp_path / "empty").mkdir()
    with pytest.raises(EdgeSlamError) as caught:
        if what == "missing":
            run(eval_command, tmp_path / "none", "--groundtruth", truth)
        elif what == "file":
            run(report_command, truth)
        else:
            run(eval_command, tmp_path / "a", "--groundtruth", tmp_path / "empty")
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("command", [report_command, view_command, compare_command, eval_command])
def test_what_scores_maps_says_so_from_the_first_second(run_folder, tmp_path, monkeypatch, command):
    own_recording(tmp_path / "a", run_folder(tmp_path / "a"))
    begun = []
    begin = Progress._begin
    monkeypatch.setattr(Progress, "_begin", lambda self, what, *rest: (begun.append(what), begin(self, what, *rest)))
    words = {compare_command: [tmp_path / "a"], view_command: ["--print"]}.get(command, [])
    assert run(command, tmp_path / "a", *words) == 0
    assert begun and begun[0] in ("making the report", "judging trajectories and maps")


def test_report_says_how_the_run_went(run_folder, tmp_path):
    truth = run_folder(tmp_path / "a")
    assert run(report_command, tmp_path / "a", "--groundtruth", truth) == 0
    page = (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
    assert "98.5\\u00a0% of the frames were tracked against the map, from the first on" in page
    assert "lost once" in page and "few matches (7)" in page
    assert "(7) </script>" not in page, "text of the run must not end the page's script"
    assert "{{" not in page.split("<script")[0]
