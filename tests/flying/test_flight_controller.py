"""Pilot and supervisor together: what counts for a verb, and who may wait for whom."""

import threading

import numpy as np
import pytest
from views import longer

from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.navigation.drone_state import DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import Phase
from edgeslam_torch.navigation.skills.skill import Result
from edgeslam_torch.navigation.supervisor import Danger

AHEAD = VelocityCommand(forward_m_s=0.4, why="ahead")


class Steady:
    """A planner with one command, or one that hangs."""

    def __init__(self, command=AHEAD):
        self.command, self.phase, self.layer, self.result = command, Phase.FLYING, None, None
        self.go_on = threading.Event()
        self.go_on.set()

    def begin(self, skill):
        self.result = None

    def update(self, state):
        assert self.go_on.wait(20.0)
        return self.command


def state(now_s, x=0.0, **fields):
    return DroneState(now_s, np.array([x, 0.0, 1.15]), 0.0, np.array([0.4, 0.0, 0.0]), **fields)


@pytest.fixture
def flight_controller():
    flight_controller = FlightController(NavLimits())
    flight_controller.pilot = Steady()
    return flight_controller


def test_orders_do_not_wait_for_a_pilot_that_hangs(flight_controller):
    flight_controller.plan(state(0.0))
    assert flight_controller.order(state(0.1)).command == AHEAD
    flight_controller.pilot.go_on.clear()
    hung = threading.Thread(target=flight_controller.plan, args=(state(0.15),))
    hung.start()
    try:
        late = flight_controller.order(state(0.45))
        assert late.danger is Danger.NO_COMMAND and late.command.sticks() == (0.0, 0.0, 0.0, 0.0)
        lands = [flight_controller.order(state(0.5 + 0.1 * k)).land for k in range(110)]
        assert not lands[90] and lands[-1]
    finally:
        flight_controller.pilot.go_on.set()
        hung.join()


def test_a_hand_on_the_keyboard_holds_it_and_lets_go(flight_controller):
    flight_controller.plan(state(0.0))
    flight_controller.hold(True)
    held = flight_controller.order(state(0.1))
    assert held.danger is Danger.HOLD and held.command.sticks() == (0.0, 0.0, 0.0, 0.0)
    flight_controller.hold(False)
    assert flight_controller.order(state(0.15)).command == AHEAD


def test_the_state_reports_an_overridden_command(flight_controller):
    told = []
    flight_controller.pilot.update = lambda state: told.append(state.overridden) or AHEAD
    for held in (False, True, False):
        flight_controller.hold(held)
        flight_controller.plan(state(0.0))
        flight_controller.order(state(0.1))
    flight_controller.plan(state(0.2, overridden=False))
    flight_controller.plan(state(0.2, overridden=True))  # as a record of a flight has it
    assert told == [False, False, True, False, True]


def test_an_empty_battery_lands_whoever_holds_it(flight_controller):
    flight_controller.hold(True)
    assert flight_controller.order(state(0.1, battery=0.05)).land


def test_way_is_counted_for_each_skill_and_the_track_for_the_flight(flight_controller):
    for k in range(21):
        flight_controller.order(state(0.05 * k, 0.05 * k))
    assert flight_controller.flown()[0] == pytest.approx(1.0, abs=0.11)
    flight_controller.begin(object())
    assert flight_controller.flown()[0] == 0.0
    assert len(flight_controller.track()) > 5 and flight_controller.track()[0] == pytest.approx([0.0, 0.0])
    length = flight_controller.track()[-1][0]
    flight_controller._supervisor.views.correct(longer(1.5))
    assert flight_controller.track()[-1] == pytest.approx([1.5 * length, 0.0]), "longer metres, a longer track"


def test_a_skill_has_ended_only_when_the_pilot_took_it_up(flight_controller):
    flight_controller.pilot.result = before = Result(True, "there")
    assert flight_controller.result() is before
    flight_controller.begin(object())
    assert flight_controller.result() is None
    flight_controller.plan(state(0.0))
    assert flight_controller.result() is None


def test_a_listener_that_fails_ends_no_flight(flight_controller):
    heard = []

    def failing(moment):
        heard.append(moment)
        raise RuntimeError("no disk")

    flight_controller = FlightController(NavLimits(), [failing])
    flight_controller.order(state(0.0))
    flight_controller.order(state(0.1))
    assert len(heard) == 1 and heard[0].state.stamp_s == 0.0
