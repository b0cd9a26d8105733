"""What a signal does to ``edgeslam record`` and ``fly``, without a drone; `tests/drone/test_ways_out.py` has one."""

import os
import signal

import pytest

from edgeslam_torch.commands.flying._signals import Signals

NAMES = [name for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)]
pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


@pytest.fixture(autouse=True)
def as_started_from_a_terminal():
    """Whatever the tests themselves were started with."""
    before = {name: signal.getsignal(getattr(signal, name)) for name in NAMES}
    for name in NAMES:
        signal.signal(getattr(signal, name), signal.SIG_DFL)
    yield
    for name, handler in before.items():
        signal.signal(getattr(signal, name), handler)


@pytest.mark.parametrize("name", NAMES)
def test_before_the_recording_a_signal_interrupts(name):
    number = getattr(signal, name)
    with Signals() as signals, pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert signals.exit_code == 128 + number
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.parametrize("name", NAMES)
def test_in_flight_no_signal_interrupts_however_often_it_comes(name):
    ends = []
    with Signals() as signals:
        signals.tell(lambda: ends.append(name), patient=True)
        for _ in range(5):
            signal.raise_signal(getattr(signal, name))
            signal.raise_signal(signal.SIGTERM)
    assert len(ends) == 10
    assert signals.exit_code == 128 + getattr(signal, name)  # the first


def test_without_a_flight_the_second_signal_interrupts():
    with Signals() as signals, pytest.raises(KeyboardInterrupt):
        signals.tell(lambda: None, patient=False)
        signal.raise_signal(signal.SIGINT)
        assert signals.number == signal.SIGINT
        signal.raise_signal(signal.SIGINT)


def test_what_nohup_ignores_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with Signals() as signals:
        signal.raise_signal(signal.SIGHUP)
        assert signals.exit_code == 0
