"""The state machine's transition table."""

import math

import pytest

from edgeslam_torch.states.machine import LEADS_TO, TRANSITIONS, Event, Machine, State


def after(*events: Event) -> Machine:
    machine = Machine()
    for stamp_s, event in enumerate(events):
        machine.apply(event, float(stamp_s))
    return machine


def test_every_state_is_reachable_and_leads_back_to_tracking():
    reach = {State.STARTING}
    for _ in State:
        reach |= {to for state in reach for to in TRANSITIONS[state].values()}
    assert reach == set(State)
    for state in State:
        onward = {state}
        for _ in State:
            onward |= {to for s in onward for to in TRANSITIONS[s].values()}
        assert State.TRACKING in onward


def test_a_loss_is_counted_from_its_first_frame_until_relocalisation():
    machine = after(Event.BEGUN, Event.MAP_READY, Event.NOTHING, Event.NOTHING, Event.NOTHING)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.LOST, 3, 2.0)
    machine.apply(Event.POINTS, 5.0)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.TRACKING, 0, math.inf)


def test_without_texture_the_restart_is_immediate():
    machine = after(Event.NO_TEXTURE)
    assert (machine.state, machine.lost_since_s) == (State.LOST, -math.inf)
    machine.apply(Event.BEGUN, 1.0)
    assert machine.state is State.STARTING


def test_edges_continue_tracking_and_hand_back_to_points():
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES).state is State.EDGES_ONLY
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES, Event.POINTS).state is State.TRACKING
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES, Event.NOTHING).lost_frames == 1


def test_an_event_leads_to_the_same_state_from_everywhere():
    assert set(LEADS_TO) == set(Event)
    for row in TRANSITIONS.values():
        assert all(LEADS_TO[event] is state for event, state in row.items())


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("event", Event)
def test_every_event_is_applied_in_every_state_and_reported_if_unlisted(state, event):
    machine = Machine()
    machine.state = state
    machine.apply(event, 3.0)
    assert machine.state is LEADS_TO[event]
    if event in TRANSITIONS[state]:
        assert machine.warning() is None
    else:
        machine.apply(Event.NOTHING, 4.0)
        assert f"{event} while {state} (1 times)" in machine.warning()
