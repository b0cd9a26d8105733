"""Progress of long work: on a terminal, in a log file, in a group of processes, and what stands beside it."""

import fcntl
import io
import os
import pty
import struct
import termios
from types import SimpleNamespace

import numpy as np
import pytest
from fake_slam import FakeSlam

from edgeslam_torch.terminal import progress as module
from edgeslam_torch.terminal.console import Console
from edgeslam_torch.terminal.progress import Progress
from edgeslam_torch.terminal.run_progress import RunProgress
from edgeslam_torch.types import Frame, TelemetrySample


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """Tests show it themselves."""
    monkeypatch.setattr(module, "SHOWN_EVERY_S", 1e6)


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def lines(total, done, every_s):
    clock, stream = Clock(), io.StringIO()
    with Progress("training", total, "step", done, stream=stream, clock=clock) as progress:
        for k in range(done, total):
            clock.now += every_s
            progress.words = f"loss {k}".__str__
            progress.advance()
            progress.show()
    return stream.getvalue().splitlines()


def test_a_line_every_five_seconds_where_there_is_no_terminal():
    shown = lines(40, 0, 1.0)
    assert len(shown) == 8
    assert shown[0] == "edgeslam: training, 5 of 40 steps, 1.0 steps/s, 35 s left, loss 4"
    assert "1 of 1 step, " in lines(1, 0, 5.0)[0]


@pytest.mark.parametrize("columns", [0, 30, 200])
def test_a_terminal_of_any_width_gets_one_line_that_fits(columns):
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with os.fdopen(slave, "w", encoding="utf-8") as terminal, Progress("深度 " * 30, stream=terminal) as progress:
        progress.show()
        shown = os.read(master, 10000).decode()
    os.close(master)
    assert shown.startswith("\redgeslam: 深度")
    assert "\n" not in shown
    assert sum(2 if c in "深度" else 1 for c in shown[1:]) < (columns or 80)


def test_messages_take_the_line_away_and_do_not_mix_with_it():
    stream = io.StringIO()
    console = Console(stream)
    stream.isatty = lambda: True
    with Progress("flying", stream=console) as progress:
        progress.show()
        console.write("edgeslam: warning: w")
        progress.show()  # not into a line that is being written
        console.write("\n")
        progress.show()
    screen = render(stream.getvalue())
    assert screen == ["edgeslam: warning: w", ""]
    assert stream.getvalue().count("flying") == 2


def render(text):
    """What a terminal would show."""
    rows = []
    for row in text.split("\n"):
        cells = []
        for part in row.split("\r"):
            cells[: len(part)] = part
        rows.append("".join(cells).rstrip())
    return rows


def test_work_within_work_is_shown_alone():
    stream = io.StringIO()
    with Progress("outer", redraw=True, stream=stream) as outer:
        with Progress("inner", redraw=True, stream=stream) as inner:
            outer.show()
            inner.show()
        assert "outer" not in stream.getvalue() and "inner" in stream.getvalue()
        outer.show()
        assert "outer" in stream.getvalue()


def test_a_run_shows_frames_pose_distance_and_the_last_refinement():
    slam, image = FakeSlam(), np.full((4, 4), 9, np.uint8)
    with RunProgress("opening") as progress:
        for i in range(3):
            frame = Frame(i, i / 30, image)
            progress.on_frame(frame, slam.step(frame), slam)
        said = progress.text()
        assert said.startswith("3 frames")
        assert "tracked, 80 inliers" in said and "at (" in said and "travelled" in said
        progress.on_last_frame(slam)
        assert progress.text() == "last refinement"


def test_the_height_is_that_of_the_frame_not_of_the_end_of_the_recording():
    slam, image = FakeSlam(), np.full((4, 4), 9, np.uint8)
    source = SimpleNamespace(
        length=3, telemetry=[TelemetrySample(t, tof_m=h) for t, h in ((0, 0.1), (1, 0.8), (2, 1.5))]
    )
    with RunProgress("opening") as progress:
        progress.follow(source)
        for stamp, height in ((-0.5, None), (0.9, "0.10"), (1.0, "0.80"), (7.0, "1.50")):
            frame = Frame(0, stamp, image)
            progress.on_frame(frame, slam.step(frame), slam)
            said = progress.text()
            assert "height" not in said if height is None else f"height {height} m" in said
