"""The dead-man's switch of the sticks against a clock that the test sets."""

from types import SimpleNamespace

import pytest
from emulated import until

from edgeslam_torch.drone import sticks
from edgeslam_torch.drone.sticks import CENTRED, FRESH_S, Sticks

PUSHED = "rc 0 0 0 20"


@pytest.fixture
def clock(monkeypatch):
    """``clock.now``, which stands still until it is set."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(sticks, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


@pytest.fixture
def held():
    """Sticks, what they sent, and a function that waits until they have looked at the clock again."""
    sent, ticks = [], []
    sticks = Sticks(sent.append, ticks.append)

    def look():
        seen = len(ticks)
        until(lambda: len(ticks) >= seen + 2)  # one tick may have begun before the clock was set

    yield sticks, sent, look
    sticks.stop()


def test_sticks_that_are_not_moved_are_centred_again_and_again_until_they_are(clock, held):
    sticks, sent, look = held
    sticks.push(PUSHED, lambda: None)
    clock.now += 1.1 * FRESH_S
    look()
    assert sent == [PUSHED, CENTRED]
    clock.now += 0.2
    look()
    assert sent == [PUSHED, CENTRED, CENTRED], "the first may be lost on the air"
    sticks.push(PUSHED, lambda: None)
    look()
    assert sent == [PUSHED, CENTRED, CENTRED, PUSHED]


def test_sticks_that_were_let_go_are_centred_once(clock, held):
    sticks, sent, look = held
    look()
    assert sent == [], "nobody has them"
    sticks.push(PUSHED, lambda: None)
    sticks.let_go()
    clock.now += 10.0
    look()
    assert sent == [PUSHED, CENTRED]


def test_a_push_that_is_not_allowed_sends_nothing(clock, held):
    sticks, sent, look = held

    def refuse():
        raise RuntimeError("landing")

    with pytest.raises(RuntimeError, match="landing"):
        sticks.push(PUSHED, refuse)
    clock.now += 10.0
    look()
    assert sent == []
