import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.drone.emulator.commands import Answer, Interpreter
from edgeslam_torch.drone.emulator.drone import DroneModel, Mode, state_line
from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk


def fly(drone, seconds):
    for _ in range(round(100 * seconds)):
        drone.step(0.01)


@pytest.fixture
def hovering():
    drone = DroneModel()
    drone.take_off()
    fly(drone, 5.0)
    return drone


def test_takes_off_to_80_cm_and_lands(hovering):
    assert hovering.mode is Mode.FLYING
    assert hovering.p_w[2] == pytest.approx(0.9, abs=0.05)
    hovering.land()
    fly(hovering, 5.0)
    assert hovering.mode is Mode.GROUND
    assert hovering.p_w[2] == pytest.approx(0.1)
    np.testing.assert_array_equal(hovering.velocity, 0.0)


def test_lands_on_a_table_that_is_under_it():
    """It stands on the top, a hull's radius above it, and rises from there again."""
    drone = DroneModel(clearance=lambda p: abs(float(p[2]) - 0.5))
    drone.p_w = np.array([0.0, 0.0, 1.2])
    drone.mode = Mode.FLYING
    for _ in range(25):  # whoever repeats the command
        drone.land()
        fly(drone, 0.2)
    assert drone.mode is Mode.GROUND
    assert drone.p_w[2] == pytest.approx(0.6, abs=0.03)
    touching = [contact for contact in drone.contacts if contact.clock_s > 3.5]
    assert not touching  # its motors are off
    assert drone.take_off()
    fly(drone, 3.0)
    assert drone.p_w[2] == pytest.approx(0.9, abs=0.05)


def test_moves_are_in_body_axes(hovering):
    hovering.turn(math.pi / 2)
    fly(hovering, 4.0)
    hovering.move(np.array([0.6, 0.0, 0.0]))
    fly(hovering, 5.0)
    assert not hovering.busy
    np.testing.assert_allclose(hovering.p_w[:2], [0.0, 0.6], atol=0.06)


def test_sticks_make_it_fly_and_turn(hovering):
    hovering.rc = (0.0, 0.5, 0.0, 0.0)
    fly(hovering, 3.0)
    assert hovering.velocity[0] == pytest.approx(0.5, abs=0.02)
    hovering.rc = (0.0, 0.0, 0.0, 1.0)
    yaw = hovering.yaw
    fly(hovering, 1.0)
    assert hovering.yaw < yaw - 1.0  # clockwise


def test_an_empty_battery_lands_it(hovering):
    hovering.battery = 0.06
    hovering.battery_per_s = 0.01
    fly(hovering, 8.0)
    assert hovering.mode is Mode.GROUND


def test_state_says_what_the_body_does_in_the_sdk_units(hovering):
    hovering.velocity = np.array([0.58, 0.31, -0.29])
    hovering.acceleration = np.zeros(3)
    hovering.yaw = 0.5
    fields = parse_state(state_line(hovering))
    assert (fields["vgx"], fields["vgy"], fields["vgz"]) == (5.0, -3.0, 2.0)  # truncated; right and down positive
    assert fields["yaw"] == round(-math.degrees(0.5))
    sample = sample_from_sdk(0.0, fields)
    np.testing.assert_allclose(sample.velocity_m_s, hovering.velocity, atol=0.1)
    assert sample.tof_m == pytest.approx(hovering.p_w[2], abs=0.01)
    np.testing.assert_allclose(sample.acceleration_m_s2, [0.0, 0.0, 9.80665], atol=0.02)


@pytest.mark.parametrize(
    ("command", "answer", "when"),
    [("takeoff", "error", Answer.NOW),  # already flying
     ("forward 100", "ok", Answer.WHEN_DONE), ("forward 10", "out of range", Answer.NOW),
     ("forward far", "error", Answer.NOW),
     ("cw 90", "ok", Answer.WHEN_DONE), ("cw 400", "out of range", Answer.NOW),
     ("go 50 0 20 40", "ok", Answer.WHEN_DONE), ("go 5 0 0 40", "out of range", Answer.NOW),
     ("rc 0 50 0 0", "", Answer.NEVER), ("dance", "unknown command: dance", Answer.NOW),
     ("battery?", "100\r\n", Answer.NOW), ("", "error", Answer.NOW)],
)  # fmt: skip
def test_commands_are_answered_as_the_sdk_says(hovering, command, answer, when):
    interpreter = Interpreter(hovering)
    interpreter.run("command")
    hovering.battery = 1.0
    reply = interpreter.run(command)
    assert (reply.text, reply.when) == (answer, when)


@given(st.one_of(st.text(max_size=60), st.sampled_from(["go", "rc", "curve", "forward", "speed", "flip"]).flatmap(
    lambda w: st.lists(st.text(max_size=5), max_size=8).map(lambda a: " ".join([w, *a])))))  # fmt: skip
def test_any_line_is_answered(line):
    interpreter = Interpreter(DroneModel())
    interpreter.run("command")
    interpreter.run("takeoff")
    interpreter.run(line)
    interpreter.drone.step(0.01)
    assert np.isfinite(interpreter.drone.p_w).all()


def test_state_without_mission_pads_is_the_older_form(hovering):
    assert state_line(hovering, mission_pads=False).startswith("pitch:")
    assert "mid" in parse_state(state_line(hovering))


def test_nothing_is_heard_before_the_word_command_and_movements_on_the_ground_are_refused():
    interpreter = Interpreter(DroneModel())
    assert interpreter.run("takeoff").when is Answer.NEVER and not interpreter.drone.flying
    interpreter.run("command")
    assert interpreter.run("up 50").text == "error Not joystick"
