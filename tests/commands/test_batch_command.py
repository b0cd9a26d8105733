"""``edgeslam batch``: mistakes of a user; and, slow, real flights in real processes."""

import csv
import os
import select
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from browser import PROGRAM, Browser

from edgeslam_torch.cli import main
from edgeslam_torch.demo import DemoSettings, record

RAY = ["--ray", "local"]


@pytest.mark.parametrize(
    "arguments",
    ["nowhere", "flights --set orb.featurs=5", "flights --ray auto --jobs 2", "flights --ray auto"],
)
def test_mistakes_are_reported_in_one_line(tmp_path, monkeypatch, write_images, capsys, arguments):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.chdir(tmp_path)
    write_images(tmp_path / "flights" / "a", ["0.png"])
    assert main(["batch", *arguments.split(), "--out", "out"]) == 1
    assert "\n" not in capsys.readouterr().err.strip()
    assert not list((tmp_path / "out").glob("flights/*"))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Three short simulated flights, and three broken recordings."""
    folder = tmp_path_factory.mktemp("fleet") / "recordings"
    for seed in range(3):
        record(folder / f"flight_{seed}", DemoSettings("corridor", 2.6, 15.0, seed, width=320, height=240))
    (folder / "empty").mkdir()
    (folder / "clip.mp4").write_bytes(b"no video")
    (folder / "no_image" / "rgb").mkdir(parents=True)
    (folder / "no_image" / "rgb.txt").write_text("1 rgb/1.png\n2 rgb/2.png\n")
    return folder


def batch_command(folder, out, *more):
    return [sys.executable, "-m", "edgeslam_torch.cli", "batch", str(folder), "--out", str(out), *more]


def rows_of(out):
    with (out / "batch.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def flight_process(out, name):
    """Number of the process that works on a flight, once it is in its middle."""
    limit_s = time.monotonic() + 200.0
    while time.monotonic() < limit_s:
        found = subprocess.run(["pgrep", "-f", f"experiment.runner {out}/jobs/{name}$"], capture_output=True, text=True)
        if found.stdout.strip() and (out / "work" / name / "status.csv").is_file():
            return int(found.stdout.split()[0])
    raise AssertionError(f"{name} was not run")


@pytest.mark.slow
def test_three_of_six_broken_and_a_process_killed(recordings, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(batch_command(recordings, out, "--jobs", "2"), stderr=subprocess.PIPE, text=True)
    os.kill(flight_process(out, "flight_2"), signal.SIGKILL)
    _, said = process.communicate(timeout=280)
    assert process.returncode == 1, said
    rows = rows_of(out)
    assert {name for name, row in rows.items() if row["state"] == "failed"} == {"empty", "clip.mp4", "no_image"}
    assert "not a video" in rows["clip.mp4"]["reason"]
    assert rows["flight_2"]["attempts"] == "2"
    assert all(row["attempts"] == "1" for name, row in rows.items() if name != "flight_2")
    assert all(float(rows[f"flight_{i}"]["ate_m"]) < 0.2 for i in range(3))


@pytest.mark.slow
def test_ctrl_c_and_a_killed_batch_leave_what_is_finished(recordings, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(batch_command(recordings, out, "--jobs", "1"), stderr=subprocess.PIPE, text=True)
    flight_process(out, "flight_1")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted; " in said
    states = {name: row["state"] for name, row in rows_of(out).items()}
    assert [states[f"flight_{i}"] for i in range(3)] == ["done", "waiting", "waiting"]
    process = subprocess.Popen(batch_command(recordings, out, "--jobs", "1"), stderr=subprocess.DEVNULL)
    child = os.pidfd_open(flight_process(out, "flight_2"))
    process.kill()
    process.wait()
    assert select.select([child], [], [], 30.0)[0], "the flight's process ends with the batch"
    os.close(child)
    done = subprocess.run(batch_command(recordings, out, "--jobs", "2"), capture_output=True, text=True)
    assert "2 of 6 flights were done before" in done.stderr
    assert sum(row["state"] == "done" for row in rows_of(out).values()) == 3


@pytest.mark.slow
def test_ray_gives_the_same_results(recordings, tmp_path):
    pytest.importorskip("ray", reason="needs the [fleet] extra: Ray is not installed")
    manifest = tmp_path / "three.csv"
    manifest.write_text(f"recording\n{recordings}/flight_1\n{recordings}/empty\n{recordings}/flight_2\n")
    for name, options in (("here", ["--jobs", "2"]), ("ray", RAY)):
        done = subprocess.run(batch_command(manifest, tmp_path / name, *options), capture_output=True, text=True)
        assert done.returncode == 1, done.stderr
    here, ray = rows_of(tmp_path / "here"), rows_of(tmp_path / "ray")
    assert [row["state"] for row in ray.values()] == ["done", "failed", "done"]
    for name in here:
        assert (here[name]["ate_m"], here[name]["reason"]) == (ray[name]["ate_m"], ray[name]["reason"])


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium")
def test_page_sorts_and_filters_in_a_browser(tmp_path):
    from edgeslam_torch.fleet.page import write_page
    from edgeslam_torch.fleet.table import Row

    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures" / "b.jpg"), np.full((40, 40, 3), 90, np.uint8))
    figures = {"a": 0.02, "b": 0.11, "c": 0.003}
    rows = [
        Row(n, "done", "", n, f"flights/{n}", picture="pictures/b.jpg", figures={"ate_m": ate})
        for n, ate in figures.items()
    ]
    write_page(tmp_path, [*rows, Row("x", "failed", "no image", "x", log="jobs/x/log.txt")])
    order = "[...document.querySelectorAll('tbody tr:not([hidden])')].map(r => r.cells[0].textContent).join('')"
    click = "[...document.querySelectorAll('th button')].find(b => b.textContent.startsWith('ATE')).click()"
    with Browser(tmp_path / "profile") as browser:
        browser.open(tmp_path / "index.html", width=390)
        assert browser.run(order) == "abcx"
        browser.run(click)
        assert browser.run(order) == "cabx", "by number, and what has none comes last"
        browser.run(click)
        assert browser.run(order) == "bacx"
        choose = "s => { s.value = 'failed'; s.dispatchEvent(new Event('change')) }"
        browser.run(f"({choose})(document.querySelector('#show'))")
        assert browser.run(order) == "x"
        assert browser.errors == []
