"""Two runs side by side."""

import re
import shutil

import numpy as np
import pytest
from browser import PROGRAM, Browser
from pages import Page
from summaries import with_summary

from edgeslam_torch import cli
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory, write_tum
from edgeslam_torch.eval.report import line_drawings
from edgeslam_torch.eval.report.comparison import write_comparison


def _changed(folder, turn=0.7, size=2.0, **summary):
    """Another world (turned, moved, ``size`` times as large), and other values in the summary."""
    run = read_trajectory(folder / "trajectory.txt")
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    T = run.T_w_c.copy()
    T[:, :3, :3] = R @ T[:, :3, :3]
    T[:, :3, 3] = size * T[:, :3, 3] @ R.T + [5.0, -3.0, 1.0]
    write_tum(Trajectory(run.stamps_s, T, "b"), folder / "trajectory.txt")
    with_summary(folder, **summary)


@pytest.fixture
def two(tmp_path, run_folder):
    run_folder(tmp_path / "a", points=500)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    _changed(tmp_path / "b", fps=20.0, source=str(tmp_path / "secret" / "place"))
    (tmp_path / "a" / "config.toml").write_text('seed = 0\n[depth]\nweights = "default"\n[orb]\nfeatures = 1000\n')
    (tmp_path / "b" / "config.toml").write_text(f'seed = 0\n[depth]\nweights = "{tmp_path}/w.safetensors"\n')
    return tmp_path / "a", tmp_path / "b"


def test_figures_and_their_difference(two, tmp_path):
    rows = {row[0]: row[1:] for row in Page(write_comparison(*two, tmp_path / "c.html")).rows}
    assert rows["frames per second"] == ["24.5", "20.0", "-4.5"]
    a, b = (float(text.split()[0]) for text in rows["length of the path"][:2])
    assert b == pytest.approx(2.0 * a, rel=1e-3)
    assert rows["orb.features"] == ["1000", "\u2013"]
    assert rows["depth.weights"] == ['"default"', '"w.safetensors"']
    assert "seed" not in rows


def test_page_may_be_passed_on_and_hostile_names_stay_text(two, tmp_path):
    bad = two[1].rename(tmp_path / "<script>alert(1)<&script>")
    page = write_comparison(two[0], bad, tmp_path / "c.html")
    parsed, text = Page(page), page.read_text()
    assert "script" not in parsed.tags and "<script>alert(1)" in parsed.texts["h1"]
    assert str(tmp_path) not in text and "secret" not in text
    assert not re.findall(r'(?:src|href)="(?!data:)', text) and "http" not in text


def test_one_path_is_aligned_to_the_other(two, tmp_path):
    text = Page(write_comparison(*two, tmp_path / "c.html")).texts["p"]
    found = re.search(
        r"B is aligned to A by (\d+) common frames .* scaled by ([\d.]+)\); .* distance is (\S+) m RMS", text
    )
    assert found is not None
    assert found[1] == "200" and float(found[2]) == pytest.approx(0.5, abs=1e-3) and float(found[3]) < 1e-6


def test_runs_without_common_frames_are_drawn_apart(two, tmp_path):
    run = read_trajectory(two[1] / "trajectory.txt")
    write_tum(Trajectory(run.stamps_s + 1e6, run.T_w_c, "b"), two[1] / "trajectory.txt")
    assert "no frames in common" in Page(write_comparison(*two, tmp_path / "c.html")).texts["p"]


def test_command_writes_reports_and_comparison(two, tmp_path, capsys):
    assert cli.main(["report", str(two[0]), str(two[1]), "--no-map-score"]) == 0
    assert [line.split()[0].rpartition("/")[2] for line in capsys.readouterr().out.splitlines()] == [
        "report.html",
        "report.html",
        "comparison.html",
    ]
    assert (tmp_path / "comparison.html").is_file()
    assert cli.main(["report", str(two[0]), str(two[1] / "trajectory.txt"), "--out", str(tmp_path / "x.html")]) == 0
    for wrong in ([str(two[0]), str(two[0])], [str(two[0]), "--out", "x.html"], [str(two[0]), str(tmp_path / "no")]):
        capsys.readouterr()
        assert cli.main(["report", *wrong]) == 1
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_drawing_keeps_shape_and_direction():
    drawn = line_drawings.view([np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])], ["red"], "m")
    points = re.search(r'points="([^"]+)"', drawn)
    assert points is not None
    xy = np.array([[float(c) for c in pair.split(",")] for pair in points[1].split()])
    right, up = xy[1] - xy[0], xy[2] - xy[1]
    assert right[0] > 0 and right[1] == 0 and up[0] == 0
    assert -up[1] == pytest.approx(right[0] / 2, abs=0.1)  # SVG's y points down
    bar = re.search(r"h([\d.]+)\".*>([\d.]+) m<", drawn)
    assert bar is not None and float(bar[1]) / float(bar[2]) == pytest.approx(right[0] / 2, rel=1e-2)


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no chromium here")
def test_page_in_a_browser(two, tmp_path):
    page = write_comparison(*two, tmp_path / "c.html")
    with Browser(tmp_path / "profile") as browser:
        browser.open(page)
        wide = "document.documentElement.scrollWidth > innerWidth + 1"
        assert browser.run(f"({{wide: {wide}, lines: document.querySelectorAll('polyline').length}})") == {
            "wide": False,
            "lines": 5,
        }
        assert browser.errors == []
