"""The way home, and its look at the take-off."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import Pilot
from edgeslam_torch.navigation.skills.return_home import ReturnHome


def at(stamp_s, x=0.0, y=0.0, yaw_deg=0.0, speed=0.0):
    place = np.array([x, y, NavLimits().height_m])
    return DroneState(stamp_s, place, math.radians(yaw_deg), np.array([speed, 0.0, 0.0]))


def way_home():
    return ReturnHome(np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]]))


def test_near_its_take_off_it_looks_as_it_did_there_and_then_it_is_home():
    task = way_home()
    assert task.look_rad(at(0.0, x=2.0, yaw_deg=180.0)) is None
    assert task.look_rad(at(1.0, x=0.5, yaw_deg=180.0)) == 0.0
    assert not task.result(at(1.0, x=0.1))
    for stamp_s in (2.0, 3.0, 4.9):
        assert task.look_rad(at(stamp_s, x=0.5, yaw_deg=3.0)) == 0.0
    task.look_rad(at(5.5, x=0.5, yaw_deg=3.0))
    assert task.look_rad(at(5.6, x=0.5)) is None
    assert (
        task.result(at(6.0, x=0.1)) and not task.result(at(6.0, x=0.1, speed=0.3)) and not task.result(at(6.0, x=0.3))
    )


def test_it_looks_for_as_long_as_it_looks_ahead_not_while_it_turns():
    task = way_home()
    for stamp_s in range(10):
        assert task.look_rad(at(float(stamp_s), x=0.4, yaw_deg=90.0)) == 0.0
    assert task.look_rad(at(10.0, x=0.4)) == 0.0
    assert not task.result(at(10.0))


def test_a_drone_that_cannot_turn_is_home_all_the_same():
    task = way_home()
    for stamp_s in range(12):
        assert task.look_rad(at(20.0 + stamp_s, x=0.1, yaw_deg=90.0)) == 0.0
    task.look_rad(at(32.5, x=0.1, yaw_deg=90.0))
    assert task.look_rad(at(33.0, x=0.1, yaw_deg=90.0)) is None and task.result(at(33.0, x=0.1, yaw_deg=90.0))


@pytest.mark.parametrize("turns", [-1, 1, 2])
def test_a_drone_that_has_turned_round_looks_ahead_all_the_same(turns):
    """The heading is unwrapped: 360 degrees are ahead."""
    task = way_home()
    for stamp_s in (0.0, 2.0, 4.0):
        task.look_rad(at(stamp_s, x=0.4, yaw_deg=360.0 * turns + 2.0))
    assert task.result(at(5.0))


@pytest.mark.parametrize(("yaw_deg", "sign"), [(120.0, -1.0), (-120.0, 1.0)])
def test_a_pilot_stands_and_turns_where_the_skill_wants_to_look(yaw_deg, sign):
    pilot = Pilot(way_home())
    command = pilot.update(at(0.0, x=0.5, yaw_deg=yaw_deg))
    assert (command.forward_m_s, command.left_m_s) == (0.0, 0.0)
    assert np.sign(command.turn_left_rad_s) == sign


def test_where_its_pose_was_lost_near_home_it_looks_from_farther_away():
    """It has backed up from the bare wall behind its take-off: it does not fly at it again."""
    task = way_home()
    assert task.look_rad(at(0.0, x=1.2, yaw_deg=180.0)) is None
    assert task.look_rad(replace(at(1.0, x=2.0, yaw_deg=180.0), tracked=False)) is None
    assert task.look_rad(at(1.5, x=1.2, yaw_deg=180.0)) is None, "that was not near"
    task.look_rad(replace(at(2.0, x=0.8, yaw_deg=180.0), tracked=False))
    assert task.look_rad(at(3.0, x=1.2, yaw_deg=180.0)) == 0.0


def looked(x):
    """A task whose look at the take-off is over, and the moment of that."""
    task = way_home()
    for stamp_s in (0.0, 2.0, 3.5):
        task.look_rad(at(stamp_s, x=x))
    return task, 3.5


def test_it_faces_as_it_looked_for_the_last_metre_and_not_for_ever():
    assert way_home().faces_rad(at(0.0, x=0.5)) is None
    task, since_s = looked(0.5)
    assert task.faces_rad(at(since_s + 0.1, x=0.5)) == 0.0
    assert task.faces_rad(at(since_s + 13.0, x=0.5)) is None


def test_a_pilot_flies_the_last_metre_backwards_and_slowly():
    """Before it what it has just known again, and the take-off behind it: no turn to what may lie elsewhere."""
    task, since_s = looked(0.55)
    pilot = Pilot(task)
    for x in np.arange(-0.5, 2.0, 0.1):
        pilot.space.flown(np.array([x, 0.0, NavLimits().height_m]), 0.6)
    commands = [pilot.update(at(since_s + 0.1 * k, x=0.55)) for k in range(1, 6)]
    assert all(-0.2 < command.forward_m_s < -0.05 and abs(command.turn_left_rad_s) < 0.05 for command in commands)
