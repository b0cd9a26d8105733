"""Pilot and supervisor together: what counts for a verb, and who may wait for whom."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.flying.cockpit import Cockpit
from edgeslam_torch.flying.errands import Stay
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.pilot import Phase
from edgeslam_torch.navigation.sight import Sight, Wish
from edgeslam_torch.navigation.supervisor import Danger

AHEAD = Wish(forward_m_s=0.4, why="ahead")


class Steady:
    """A pilot that wants one thing, or hangs."""

    def __init__(self, wish=AHEAD):
        self.wish, self.phase, self.layer, self.task = wish, Phase.FLYING, None, None
        self.go_on = threading.Event()
        self.go_on.set()

    def begin(self, task):
        self.task, self.phase = task, Phase.FLYING

    def update(self, sight):
        assert self.go_on.wait(20.0)
        return self.wish


def sight(now_s, x=0.0, **fields):
    return Sight(now_s, np.array([x, 0.0, 1.15]), 0.0, np.array([0.4, 0.0, 0.0]), **fields)


@pytest.fixture
def cockpit():
    cockpit = Cockpit(NavLimits())
    cockpit.pilot = Steady()
    return cockpit


def test_orders_do_not_wait_for_a_pilot_that_hangs(cockpit):
    cockpit.plan(sight(0.0))
    assert cockpit.order(sight(0.1)).wish == AHEAD
    cockpit.pilot.go_on.clear()
    hung = threading.Thread(target=cockpit.plan, args=(sight(0.15),))
    hung.start()
    try:
        late = cockpit.order(sight(0.45))
        assert late.danger is Danger.NO_WISH and late.wish.sticks() == (0.0, 0.0, 0.0, 0.0)
        lands = [cockpit.order(sight(0.5 + 0.1 * k)).land for k in range(110)]
        assert not lands[90] and lands[-1]
    finally:
        cockpit.pilot.go_on.set()
        hung.join()


def test_a_hand_on_the_keyboard_holds_it_and_lets_go(cockpit):
    cockpit.plan(sight(0.0))
    cockpit.hold(True)
    held = cockpit.order(sight(0.1))
    assert held.danger is Danger.HAND and held.wish.sticks() == (0.0, 0.0, 0.0, 0.0)
    cockpit.hold(False)
    assert cockpit.order(sight(0.15)).wish == AHEAD


def test_a_pilot_knows_that_its_wish_was_not_followed(cockpit):
    told = []
    cockpit.pilot.update = lambda sight: told.append(sight.hindered) or AHEAD
    for held in (False, True, False):
        cockpit.hold(held)
        cockpit.plan(sight(0.0))
        cockpit.order(sight(0.1))
    cockpit.plan(sight(0.2, hindered=False))
    cockpit.plan(sight(0.2, hindered=True))  # as a record of a flight has it
    assert told == [False, False, True, False, True]


def test_an_empty_battery_lands_whoever_holds_it(cockpit):
    cockpit.hold(True)
    assert cockpit.order(sight(0.1, battery=0.05)).land


def test_way_is_counted_for_each_task_and_the_track_for_the_flight(cockpit):
    for k in range(21):
        cockpit.order(sight(0.05 * k, 0.05 * k))
    assert cockpit.flown()[0] == pytest.approx(1.0, abs=0.11)
    cockpit.begin(object())
    assert cockpit.flown()[0] == 0.0
    assert len(cockpit.track()) > 5 and cockpit.track()[0] == pytest.approx([0.0, 0.0])
    length = cockpit.track()[-1][0]
    here = np.eye(4)[None]
    cockpit.pilot.task = Stay()
    cockpit.begin(Stay())
    cockpit.plan(replace(sight(2.0, 0.5), revision=1, moved=Moved(here, here, 1.5)))
    assert cockpit.track()[-1] == pytest.approx([1.5 * length, 0.0]), "longer metres, a longer track"


def test_a_task_has_ended_only_when_the_pilot_took_it_up(cockpit):
    cockpit.pilot.phase = Phase.DONE
    assert cockpit.ended() is Phase.DONE
    cockpit.begin(object())
    assert cockpit.ended() is None
    cockpit.plan(sight(0.0))
    assert cockpit.ended() is None and cockpit.pilot.phase is Phase.FLYING


def test_a_listener_that_fails_ends_no_flight(cockpit):
    heard = []

    def failing(moment):
        heard.append(moment)
        raise RuntimeError("no disk")

    cockpit = Cockpit(NavLimits(), [failing])
    cockpit.order(sight(0.0))
    cockpit.order(sight(0.1))
    assert len(heard) == 1 and heard[0].sight.stamp_s == 0.0
