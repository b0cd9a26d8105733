"""The emulated Tello on a simulated clock."""

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.drone import Contact, DroneModel, Mode
from edgeslam_torch.drone.emulator.lockstep import LockstepTello, Outage, Picture, Radio, Reply, State
from edgeslam_torch.drone.sdk_state import parse_state


def nothing(T_w_b):
    return np.zeros((2, 2, 3), np.uint8)


def flown(seconds=8.0, radio=None, drone=None, seed=0, commands=((0.1, "takeoff"), (5.0, "rc 0 50 0 0"))):
    """All events of a short flight, and the drone."""
    tello = LockstepTello(drone or DroneModel(), nothing, radio or Radio(), seed)
    events, todo = [], list(commands)
    while tello.clock_s < seconds - 1e-9:
        if todo and tello.clock_s >= todo[0][0] - 1e-9:
            tello.send(todo.pop(0)[1])
        events += tello.advance(0.1)
    return events, tello.drone


def test_a_flight_depends_on_its_seed_alone():
    radio = Radio(loss=0.2)
    first, again, other = (flown(radio=radio, seed=seed)[0] for seed in (3, 3, 4))
    told = [[e.text for e in run if isinstance(e, State)] for run in (first, again, other)]
    assert told[0] == told[1]
    assert told[0] != told[2]


def test_pictures_come_after_the_stated_delay_in_order():
    pictures = [e for e in flown(2.0, Radio(video_s=0.4))[0] if isinstance(e, Picture)]
    delay = np.array([p.arrived_s - p.captured_s for p in pictures])
    np.testing.assert_allclose(delay, 0.4, atol=1e-9)
    assert np.all(np.diff([p.captured_s for p in pictures]) > 0)
    assert len(pictures) == pytest.approx(15 * (2.0 - 0.4), abs=1)


def test_a_command_takes_effect_after_the_radio_delay():
    events, drone = flown(6.0, Radio(command_s=0.5), commands=((0.0, "takeoff"), (5.0, "rc 0 100 0 0")))
    at = {round(e.arrived_s, 2): parse_state(e.text)["vgx"] for e in events if isinstance(e, State)}
    before = [v for t, v in at.items() if t < 5.5]
    assert max(map(abs, before)) == 0
    assert drone.velocity[0] > 0.3


def test_an_outage_silences_its_channel_only():
    radio = Radio(outages=(Outage("video", 1.0, 3.0),))
    events, _ = flown(6.0, radio)
    taken = [e.captured_s for e in events if isinstance(e, Picture)]
    assert not [t for t in taken if 1.0 <= t < 3.0]
    assert [t for t in taken if t >= 3.0]
    assert len([e for e in events if isinstance(e, State)]) > 55


def test_hitting_a_wall_is_an_event_with_its_speed():
    wall = DroneModel(clearance=lambda p: 1.0 - p[0])
    events, drone = flown(8.0, drone=wall, commands=((0.0, "takeoff"), (4.0, "rc 0 100 0 0")))
    (hit,) = [e for e in events if isinstance(e, Contact)]
    assert hit.crashed and hit.speed_m_s > 0.6
    assert drone.mode is Mode.GROUND
    assert drone.p_w[0] == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_time_that_does_not_pass_is_refused(seconds):
    with pytest.raises(ValueError, match="step"):
        LockstepTello(DroneModel(), nothing).advance(seconds)


def test_take_off_is_answered_when_it_is_over():
    replies = [e for e in flown(8.0, commands=((0.0, "takeoff"),))[0] if isinstance(e, Reply)]
    assert [r.text for r in replies] == ["ok"]
    assert replies[0].arrived_s > 1.0


def test_silence_lands_it():
    _, drone = flown(25.0, commands=((0.0, "takeoff"),))
    assert drone.mode is Mode.GROUND


@pytest.mark.parametrize("wrong", [{"loss": 1.0}, {"video_s": -0.1}, {"video_hz": 0.0}])
def test_impossible_radios_are_refused(wrong):
    with pytest.raises(ValueError):
        Radio(**wrong)
