"""``edgeslam record`` over a faulty link: it ends by itself, says why, leaves the drone on the floor and a flight
that runs.

Nothing here asserts how long anything takes; what must happen in the end is waited for.
"""

import json
import re
import threading
from contextlib import closing

import numpy as np
import pytest
from emulated import emulated, on_the_floor, until

from edgeslam_torch.cli import main
from edgeslam_torch.drone import tello
from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.readers.source import open_source

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize("frozen", [False, True])
def test_an_outage_of_three_seconds_and_a_drone_that_stops_answering(tmp_path, capsys, monkeypatch, frozen):
    """Frozen, the drone receives nothing any more and lands by itself; that flight fails."""
    monkeypatch.setattr(tello, "_LAND_AGAIN_S", 0.5 if frozen else tello._LAND_AGAIN_S)
    folder, stop = tmp_path / "flight", threading.Event()
    with emulated() as (emulator, url):

        def fail():
            while emulator.drone.mode is not Mode.FLYING and not stop.wait(0.02):
                pass
            emulator.frozen, emulator.link.cut = frozen, not frozen
            stop.wait(3.0)
            emulator.link.cut = False

        threading.Thread(target=fail, daemon=True).start()
        most = [] if frozen else ["--max-frames", "150"]
        assert main(["record", url, "--out", str(folder), "--fly", *most]) == frozen
        stop.set()
        until(lambda: on_the_floor(emulator))
    said, errors = capsys.readouterr()
    with closing(open_source(folder)) as source:
        frames = list(source.frames())
        assert not source.problems
        assert len(source.telemetry) == (folder / "state.txt").read_text().count("\n") > 0
    assert len(frames) == (folder / "rgb.txt").read_text().count("\n") - 1 >= (5 if frozen else 150)
    steps_s = np.diff([frame.stamp_s for frame in frames])
    assert all(steps_s > 0)
    if frozen:
        reason = r"edgeslam: error: 127.0.0.1: the flight was ended: no (state|video) for 5 s"
        assert re.fullmatch(reason, errors.splitlines()[-1])
    else:
        assert "150 frames" in said and steps_s.max() > 2.0 and np.argmax(steps_s) + 2 < len(frames), "it went on"
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out), "--max-frames", "30", "--no-report", "--no-progress"]) == 0
    assert json.loads((out / "summary.json").read_text())["frames"] == min(30, len(frames))
