"""The state machine's transition table."""

import math

from edgeslam_torch.states.machine import NEXT, Event, Machine, State


def after(*events):
    machine = Machine()
    for stamp_s, event in enumerate(events):
        machine.apply(event, float(stamp_s))
    return machine


def test_every_event_leads_to_a_state_and_every_state_is_reached():
    assert set(NEXT) == set(Event)
    assert set(NEXT.values()) == set(State)


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
