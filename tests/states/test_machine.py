"""The state machine's transition table."""

import math

from edgeslam_torch.states.machine import Event, Machine, State


def after(*events):
    machine = Machine()
    for stamp_s, event in enumerate(events):
        machine.apply(event, float(stamp_s))
    return machine


def test_a_loss_is_counted_from_its_first_frame_until_relocalisation():
    machine = after(Event.BEGUN, Event.MAP_READY, Event.NOTHING, Event.NOTHING, Event.NOTHING)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.LOST, 3, 2.0)
    machine.apply(Event.POINTS, 5.0)
    assert (machine.state, machine.lost_frames, machine.lost_since_s) == (State.TRACKING, 0, math.inf)


def test_edges_continue_tracking_and_hand_back_to_points():
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES).state is State.EDGES_ONLY
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES, Event.POINTS).state is State.TRACKING
    assert after(Event.BEGUN, Event.MAP_READY, Event.EDGES, Event.NOTHING).lost_frames == 1
