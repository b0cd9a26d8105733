"""Progress of long work: on a terminal, in a log file, in a group of processes."""

import io
from unittest import mock

from edgeslam_torch.train.processes import counting
from edgeslam_torch.train.processes.counting import Count, counted


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines(total: int, done: int, every_s: float) -> list[str]:
    now = [100.0]
    stream = io.StringIO()
    count = Count(total, "training", "step", done, stream, lambda: now[0])
    for k in range(done, total):
        now[0] += every_s
        count.advance(f"loss {k}")
    count.close()
    return stream.getvalue().splitlines()


def test_a_line_every_five_seconds_where_there_is_no_terminal() -> None:
    shown = lines(40, 0, 1.0)
    assert len(shown) == 8
    assert shown[0] == "edgeslam: training: step 5 of 40, 35 s left, loss 4"


def test_slow_work_shows_every_item() -> None:
    assert lines(2, 0, 60.0) == [
        "edgeslam: training: step 1 of 2, 60 s left, loss 0",
        "edgeslam: training: step 2 of 2, 0 s left, loss 1",
    ]


def test_what_was_done_before_is_no_part_of_the_rate() -> None:
    assert lines(100, 90, 5.0)[0] == "edgeslam: training: step 91 of 100, 45 s left, loss 90"


def test_terminal_gets_a_bar() -> None:
    stream = _Terminal()
    count = Count(3, "training", "step", stream=stream)
    for _ in range(3):
        count.advance("loss 0.1")
    count.close()
    assert "training" in stream.getvalue()
    assert "\r" in stream.getvalue()


def test_other_processes_of_a_group_are_silent() -> None:
    stream = io.StringIO()
    with mock.patch.object(counting, "rank", lambda: 1):
        count = Count(2, "training", "step", stream=stream, clock=iter(range(0, 100, 10)).__next__)
    count.advance()
    count.advance()
    assert stream.getvalue() == ""


def test_counted_gives_the_items() -> None:
    assert list(counted(["a", "b"], "reading", "image")) == ["a", "b"]
