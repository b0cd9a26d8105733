import io
import re

import numpy as np
import pytest
from fake_slam import FakeSlam

from edgeslam_torch import progress
from edgeslam_torch.types import Frame


def frames(count):
    slam = FakeSlam()
    image = np.full((4, 4), 9, np.uint8)
    for i in range(count):
        frame = Frame(i, i / 30, image)
        yield frame, slam.step(frame)


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test sets."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_line_every_few_seconds_with_rate_and_time_left(clock):
    stream = io.StringIO()
    with progress.make_progress(200, False, stream) as lines:
        clock[0] += 60.0  # loading, which counts for nothing
        for frame, output in frames(101):
            lines.on_frame(frame, output, None)
            clock[0] += 0.1
    text = stream.getvalue().splitlines()
    assert len(text) in (1, 2)
    assert re.match(r"edgeslam: 5[12]/200 frames, 10\.[12] frames/s, 15 s left, tracked, 80 inliers", text[0])


def test_unknown_length_has_no_time_left(clock):
    stream = io.StringIO()
    lines = progress.make_progress(None, False, stream)
    for frame, output in frames(60):
        lines.on_frame(frame, output, None)
        clock[0] += 0.1
    assert "left" not in stream.getvalue()
    assert " frames, 10." in stream.getvalue()


def test_bar_shows_status():
    stream = io.StringIO()
    with progress.make_progress(3, True, stream) as bar:
        for frame, output in frames(3):
            bar.on_frame(frame, output, None)
    assert "3/3" in stream.getvalue()
    assert "tracked, 80 inliers" in stream.getvalue()
