"""``edgeslam record`` over a faulty link: it ends by itself, says why, leaves the drone on the floor and a flight
that runs.

Nothing here asserts how long anything takes; what must happen in the end is waited for.
"""

import json
import re
import threading
from contextlib import closing, contextmanager

import numpy as np
import pytest
from emulated import PATIENCE_S, emulated, on_the_floor, until

from edgeslam_torch.cli import main
from edgeslam_torch.drone import tello
from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.readers.source import open_source

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")


@contextmanager
def meanwhile(work):
    """``work(stop)`` in a thread beside the block."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def wait_until(condition, stop):
    while not condition() and not stop.wait(0.02):
        pass


def check_flight(folder, tmp_path, min_frames):
    """Every frame and message that was listed is there, and ``edgeslam run`` takes the folder."""
    source = open_source(folder)
    with closing(source):
        frames = list(source.frames())
        listed = [line for line in (folder / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
        assert len(frames) == len(listed) >= min_frames
        assert not source.problems
        assert len(source.telemetry) == (folder / "state.txt").read_text().count("\n") > 0
    assert all(np.diff([f.stamp_s for f in frames]) > 0)
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out), "--max-frames", "30", "--no-report", "--no-progress"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == min(30, len(frames))
    return frames


def record(url, folder, *options):
    return main(["record", url, "--out", str(folder), "--fly", *options])


@pytest.mark.slow
@pytest.mark.alone
def test_an_outage_of_three_seconds(tmp_path, capsys):
    with emulated() as (emulator, url):

        def cut(stop):
            wait_until(lambda: emulator.drone.mode is Mode.FLYING, stop)
            emulator.link.cut = True
            stop.wait(3.0)
            emulator.link.cut = False

        with meanwhile(cut):
            assert record(url, tmp_path / "flight", "--max-frames", "150") == 0
        assert on_the_floor(emulator)
    assert "150 frames" in capsys.readouterr().out
    frames = check_flight(tmp_path / "flight", tmp_path, 150)
    gap = int(np.argmax(np.diff([f.stamp_s for f in frames])))
    assert frames[gap + 1].stamp_s - frames[gap].stamp_s > 2.0
    assert gap + 2 < len(frames)  # it went on


@pytest.mark.slow
@pytest.mark.alone
def test_a_drone_that_stops_answering(tmp_path, capsys, monkeypatch):
    """The only flight here that fails: the drone receives nothing any more and lands by itself."""
    monkeypatch.setattr(tello, "_LAND_AGAIN_S", 0.5)
    with emulated() as (emulator, url):

        def freeze(stop):
            wait_until(lambda: emulator.drone.mode is Mode.FLYING, stop)
            emulator.frozen = True

        with meanwhile(freeze):
            assert record(url, tmp_path / "flight") == 1
        until(lambda: on_the_floor(emulator))
    error = capsys.readouterr().err.splitlines()[-1]
    assert re.fullmatch(r"edgeslam: error: 127.0.0.1: the flight was ended: no (state|video) for 5 s", error)
    check_flight(tmp_path / "flight", tmp_path, 5)
