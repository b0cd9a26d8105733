"""The state machine's transition table."""

import math

import pytest

from edgeslam_torch.states.machine import TRANSITIONS, Event, Machine, State


def after(*events: Event) -> Machine:
    machine = Machine()
    for stamp_s, event in enumerate(events):
        machine.meet(event, float(stamp_s))
    return machine


def test_every_state_is_reached_from_the_start_and_leads_back_to_tracking():
    reach = {State.STARTING}
    for _ in State:
        reach |= {to for state in reach for to in TRANSITIONS[state].values()}
    assert reach == set(State)
    for state in State:
        onward = {state}
        for _ in State:
            onward |= {to for s in onward for to in TRANSITIONS[s].values()}
        assert State.TRACKING in onward


def test_a_loss_is_counted_from_its_first_frame_and_forgotten_when_found_again():
    machine = after(Event.BEGUN, Event.MAP_STANDS, Event.NOTHING, Event.NOTHING, Event.NOTHING)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.LOST, 3, 2.0)
    machine.meet(Event.POINTS, 5.0)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.TRACKING, 0, math.inf)


def test_without_texture_there_is_nothing_to_wait_for():
    machine = after(Event.NO_TEXTURE)
    assert (machine.state, machine.lost_since_s) == (State.LOST, -math.inf)
    machine.meet(Event.BEGUN, 1.0)
    assert machine.state is State.STARTING


def test_edges_carry_on_from_tracking_and_hand_back():
    assert after(Event.BEGUN, Event.MAP_STANDS, Event.EDGES).state is State.EDGES_ONLY
    assert after(Event.BEGUN, Event.MAP_STANDS, Event.EDGES, Event.POINTS).state is State.TRACKING
    assert after(Event.BEGUN, Event.MAP_STANDS, Event.EDGES, Event.NOTHING).lost_frames == 1


@pytest.mark.parametrize(
    "events",
    [
        (Event.POINTS,),  # no map yet
        (Event.BEGUN, Event.MAP_STANDS, Event.BEGUN),  # a new piece without a loss
        (Event.BEGUN, Event.MAP_STANDS, Event.NOTHING, Event.EDGES),  # edges look near a prediction only
    ],
)
def test_what_cannot_happen_is_an_error(events):
    with pytest.raises(KeyError):
        after(*events)
