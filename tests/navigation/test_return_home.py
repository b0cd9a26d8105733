"""The way home, and its look at the take-off."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import Pilot
from edgeslam_torch.navigation.skills.return_home import ReturnHome
from edgeslam_torch.navigation.views import ViewPlanner


def at(stamp_s, x=0.0, y=0.0, yaw_deg=0.0, speed=0.0):
    place = np.array([x, y, NavLimits().height_m])
    return DroneState(stamp_s, place, math.radians(yaw_deg), np.array([speed, 0.0, 0.0]))


def way_home():
    return ReturnHome(np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]]))


def flown_home(state, seconds, turn_rad_s=1.0, task=None):
    """A drone that turns as it is told and does not move; its task, its pilot and the time of the look."""
    pilot, looks_s = Pilot(task or way_home()), 0.0
    for _ in range(round(10 * seconds)):
        command = pilot.update(state)
        looks_s += 0.1 * (command.why == "look")
        turn = float(np.clip(command.turn_left_rad_s, -turn_rad_s, turn_rad_s))
        there = state.p_w + [0.0, 0.0, 0.1 * command.up_m_s]
        state = replace(state, stamp_s=state.stamp_s + 0.1, yaw_rad=state.yaw_rad + 0.1 * turn, p_w=there)
    return pilot, state, looks_s


@pytest.mark.parametrize(("x", "speed", "home"), [(0.1, 0.0, True), (0.1, 0.3, False), (0.4, 0.0, False)])
@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_near_its_take_off_it_looks_as_it_did_there_and_then_it_is_home(x, speed, home, turns):
    """Above it and slow; the heading is unwrapped: 360 degrees are ahead."""
    pilot, state, _ = flown_home(at(0.0, x, yaw_deg=360.0 * turns + 120.0, speed=speed), 14.0)
    assert abs(state.turn_to_rad(0.0)) < math.radians(10.0)
    assert (pilot.result is not None) is home and (not home or pilot.result.reached)


def test_it_looks_for_as_long_as_it_looks_ahead_not_while_it_turns():
    quick, slow = (flown_home(at(0.0, 0.1, yaw_deg=yaw), 14.0)[2] for yaw in (5.0, 150.0))
    assert slow > quick + 1.5


def test_a_drone_that_cannot_turn_is_home_all_the_same():
    pilot = flown_home(at(0.0, 0.1, yaw_deg=90.0), 25.0, turn_rad_s=0.0)[0]
    assert pilot.result.reached


def test_far_from_its_take_off_it_flies_on():
    assert not way_home().looks(at(0.0, x=2.0), ViewPlanner(0.15))


def test_where_its_pose_was_lost_near_home_it_looks_from_farther_away():
    """It has backed up from the bare wall behind its take-off: it does not fly at it again."""
    task, views = way_home(), ViewPlanner(0.15)
    assert not task.looks(at(0.0, x=1.2), views)
    assert not task.looks(replace(at(1.0, x=2.0), tracked=False), views)
    assert not task.looks(at(1.5, x=1.2), views), "that was not near"
    assert not task.looks(replace(at(2.0, x=0.8), tracked=False), views)
    assert task.looks(at(3.0, x=1.2), views)


def test_a_pilot_flies_the_last_metre_backwards_and_slowly():
    """Before it what it has just known again, and the take-off behind it: no turn to what may lie elsewhere."""
    pilot = Pilot(way_home())
    for x in np.arange(-0.5, 2.0, 0.1):
        pilot.space.flown(np.array([x, 0.0, NavLimits().height_m]), 0.6)
    commands, state = [], at(0.0, x=0.55)
    for k in range(90):
        commands.append(pilot.update(state))
        state = replace(state, stamp_s=0.1 * k, p_w=state.p_w + [0.0, 0.0, 0.1 * commands[-1].up_m_s])
    moving = [command for command in commands if command.why == "along the path"]
    assert moving and all(-0.31 < c.forward_m_s < 0.001 and abs(c.turn_left_rad_s) < 0.05 for c in moving)
    assert min(c.forward_m_s for c in moving) < -0.1
