"""Supervisor between planner and sticks."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.supervisor import LAND_S, UNSURE_LAND_S, Danger, Supervisor

AHEAD = VelocityCommand(forward_m_s=0.5, why="ahead")
BACK = np.array([-0.2, 0.0, 0.0])
"""As it moves while it backs up."""


def state(now_s, x=0.0, **fields):
    fields = {"velocity_w": np.array([0.5, 0.0, 0.0]), "seen_s": now_s - 0.4} | fields
    return DroneState(now_s, np.array([x, 0.0, 1.1]), 0.0, **fields)


def flown(supervisor, seconds, change=lambda s: s, command=AHEAD, begin_s=0.0, x=0.0):
    """Orders of a straight flight; ``change`` spoils its states, ``command`` None is a pilot that hangs."""
    orders = []
    for k in range(round(20 * seconds)):
        now = begin_s + k / 20
        supervisor.see(change(state(now, x + 0.025 * k)))
        if command is not None:
            supervisor.propose(command, now)
        orders.append(supervisor.order(now))
    return orders


def test_a_healthy_flight_is_left_alone():
    orders = flown(Supervisor(), 3.0)
    assert all(o.command == AHEAD and not o.land and o.danger is Danger.NONE for o in orders)


def test_hanging_planner_centres_sticks_then_lands():
    supervisor = Supervisor()
    flown(supervisor, 1.0)
    orders = flown(supervisor, LAND_S + 1.0, command=None, begin_s=1.0)
    at_half_a_second = orders[10]
    assert at_half_a_second.danger is Danger.NO_COMMAND
    assert at_half_a_second.command.sticks() == (0.0, 0.0, 0.0, 0.0)
    assert not orders[150].land and orders[-1].land


def test_stale_frame_stops_and_backs_up():
    supervisor = Supervisor()
    flown(supervisor, 3.0)
    blind = flown(
        supervisor,
        LAND_S + 1.5,
        lambda s: replace(s, p_w=np.array([1.5, 0.0, 1.1]), velocity_w=np.zeros(3), seen_s=2.6),
        command=VelocityCommand(),
        begin_s=3.0,
    )
    assert blind[0].danger is Danger.NONE  # 0.4 s old, as always
    assert blind[10].danger is Danger.BLIND and blind[10].command.forward_m_s == 0.0
    assert blind[50].command.forward_m_s < -0.1
    assert abs(blind[150].command.forward_m_s) < 1e-9
    assert blind[-1].land


@pytest.mark.parametrize(
    ("spoilt", "danger"),
    [
        ({"tracked": False, "position_sigma_m": 0.15}, Danger.LOST),
        ({"scale_sigma": 0.15}, Danger.SCALE),
        ({"conflict": True}, Danger.SCALE),
        ({"metric": False}, Danger.NOT_METRIC),
    ],
)
def test_dangers_stop_the_drone(spoilt, danger):
    supervisor = Supervisor()
    flown(supervisor, 1.0)
    orders = flown(supervisor, 1.0, lambda s: replace(s, **spoilt), begin_s=1.0)
    assert {o.danger for o in orders} == {danger}
    assert all(o.command.forward_m_s == 0.0 for o in orders)


def test_dead_reckoning_continues_while_the_position_is_certain():
    supervisor = Supervisor()
    flown(supervisor, 1.0)
    carried = {"tracked": False, "position_sigma_m": 0.1}
    orders = flown(supervisor, 1.0, lambda s: replace(s, **carried), begin_s=1.0, x=0.5)
    assert all(o.command == AHEAD and o.danger is Danger.DEAD_RECKONING for o in orders)  # done, and said
    waiting = flown(
        supervisor, 0.2, lambda s: replace(s, **carried), VelocityCommand(turn_left_rad_s=0.5), begin_s=2.0, x=1.0
    )
    assert {o.danger for o in waiting} == {Danger.LOST}  # it turns to what it may not know either


def test_backs_up_a_metre_beyond_the_last_tracked_position():
    """Tracking was lost at 1 m; dead reckoning led to 2 m."""
    supervisor = Supervisor()
    flown(supervisor, 2.0)
    flown(supervisor, 2.0, lambda s: replace(s, tracked=False, position_sigma_m=0.1), begin_s=2.0, x=1.0)
    x, commands = 1.975, []
    for k in range(400):
        now = 4.0 + k / 20
        supervisor.see(replace(state(now, x), tracked=False, position_sigma_m=0.2))
        supervisor.propose(AHEAD, now)
        commands.append(supervisor.order(now))
        x += commands[-1].command.forward_m_s / 20
        if commands[-1].land:
            break
    assert x == pytest.approx(0.0, abs=0.15)
    assert max(o.command.forward_m_s for o in commands) <= 0.0


def test_backs_up_despite_lateral_drift():
    """By more than the steps in which the way is kept, half a metre back: onto it, and not forward to its end."""
    supervisor = Supervisor()
    flown(supervisor, 3.0)
    aside = {"p_w": np.array([0.975, 0.2, 1.1]), "velocity_w": BACK, "tracked": False, "position_sigma_m": 0.2}
    lost = flown(supervisor, 4.0, lambda s: replace(s, **aside), begin_s=3.0)
    assert lost[-1].command.why.endswith("back up along the path flown") and lost[-1].command.left_m_s < 0.0
    assert lost[-1].command.forward_m_s < 1e-6


def test_backs_up_along_the_latest_pass():
    """Out to 3 m and back to 1 m beside that, then a bare wall: back towards 3 m, where its pose was known last."""
    supervisor = Supervisor()
    flown(supervisor, 6.0)
    for k in range(80):
        supervisor.see(replace(state(6.0 + k / 20, 3.0 - 0.025 * k), p_w=np.array([3.0 - 0.025 * k, 0.1, 1.1])))
        supervisor.propose(AHEAD, 6.0 + k / 20)
        supervisor.order(6.0 + k / 20)
    stays = {"p_w": np.array([1.0, 0.1, 1.1]), "velocity_w": -BACK, "tracked": False, "position_sigma_m": 0.2}
    lost = flown(supervisor, 4.0, lambda s: replace(s, **stays), begin_s=10.0)
    backing = [o.command for o in lost if o.command.why.endswith("back up along the path flown")]
    assert backing and all(command.forward_m_s > 0.1 for command in backing)


def test_backing_up_speed_is_dithered():
    """Truncated to whole dm/s with half a step added, a constant speed would be wrong by up to half a step."""
    supervisor = Supervisor()
    flown(supervisor, 6.0)
    stays = {"p_w": np.array([2.9, 0.0, 1.1]), "velocity_w": BACK, "tracked": False, "position_sigma_m": 0.2}
    lost = flown(supervisor, 5.45, lambda s: replace(s, **stays), begin_s=6.0)
    speeds = [-o.command.forward_m_s for o in lost if o.command.why.endswith("back up along the path flown")][:80]
    assert len(speeds) >= 75
    told = [math.floor(10.0 * v) / 10.0 + 0.05 for v in speeds]
    assert sum(told) == pytest.approx(sum(speeds), rel=0.03)
    assert sum(speeds) / len(speeds) == pytest.approx(0.25, abs=0.01)


def test_backing_up_avoids_velocities_below_the_quantisation_step():
    """A few centimetres beside the path it does not creep back, which telemetry would report as standing."""
    supervisor = Supervisor()
    flown(supervisor, 3.0)
    aside = {"p_w": np.array([0.975, 0.03, 1.1]), "velocity_w": BACK, "tracked": False, "position_sigma_m": 0.2}
    lost = flown(supervisor, 4.0, lambda s: replace(s, **aside), begin_s=3.0)
    backing = [o.command for o in lost if o.command.why.endswith("back up along the path flown")]
    assert backing and all(command.left_m_s == 0.0 and command.forward_m_s < -0.15 for command in backing)


def test_tracking_loss_in_a_turn_turns_back():
    """It turned left from 0, and lost the map at 45 degrees: it turns right again, back to what it saw before."""
    supervisor = Supervisor()
    yaw, turns = 0.0, []
    for k in range(60):
        now, lost = k / 20, k > 30
        yaw = min(k, 30) / 30 * math.radians(45.0) if not lost else yaw + turns[-1] / 20
        supervisor.see(replace(state(now), yaw_rad=yaw, tracked=not lost, velocity_w=np.zeros(3)))
        supervisor.propose(VelocityCommand(turn_left_rad_s=0.5), now)
        turns.append(supervisor.order(now).command.turn_left_rad_s)
    assert max(turns[31:40]) < -0.5
    assert yaw == pytest.approx(math.radians(45.0 * (30 - 24) / 30), abs=math.radians(5.0))


def test_uncertain_scale_oscillates_within_height_limits():
    supervisor = Supervisor(NavLimits(highest_m=1.15))
    orders = flown(supervisor, 5.0, lambda s: replace(s, metric=False))
    up = [o.command.up_m_s for o in orders]
    assert max(up) > 0.1 and min(up) < -0.1
    high = flown(supervisor, 1.0, lambda s: replace(s, metric=False, p_w=np.array([0, 0, 1.3])), begin_s=5.0)
    assert max(o.command.up_m_s for o in high) <= 0.0


def test_commanded_and_not_moving_is_a_contact_and_lands_in_the_end():
    supervisor = Supervisor()
    flown(supervisor, 1.0)
    held = flown(
        supervisor, 8.0, lambda s: replace(s, p_w=np.array([0.5, 0, 1.1]), velocity_w=np.zeros(3)), begin_s=1.0
    )
    assert held[20].danger is Danger.NONE
    assert held[40].danger is Danger.CONTACT
    assert held[-1].land


def test_contact_is_reported_once_with_its_direction():
    """Heading along y with a command to the left: along -x."""
    supervisor = Supervisor()
    still = {"p_w": np.array([0.5, 0, 1.1]), "velocity_w": np.zeros(3), "yaw_rad": math.pi / 2}
    contacts = []
    for k in range(60):
        now = 1.0 + k / 15
        supervisor.see(replace(state(now), **still))
        supervisor.propose(VelocityCommand(left_m_s=0.4), now)
        contacts.append(supervisor.order(now).contact)
    (contact,) = [t for t in contacts if t is not None]
    np.testing.assert_allclose(contact.p_w, [0.5, 0, 1.1])
    np.testing.assert_allclose(contact.towards_w, [-1.0, 0.0], atol=1e-9)


def test_overridden_command_is_no_contact():
    """Metres are not sure: it goes up and down whatever the pilot commands, and that is no contact."""
    supervisor = Supervisor()
    flown(supervisor, 1.0)
    still = {"velocity_w": np.zeros(3), "p_w": np.array([0.5, 0, 1.1])}
    waiting = flown(supervisor, 5.0, lambda s: replace(s, scale_sigma=0.2, **still), begin_s=1.0)
    assert {o.danger for o in waiting} == {Danger.SCALE}
    goes_on = flown(supervisor, 1.0, lambda s: replace(s, **still), begin_s=6.0)
    assert goes_on[-1].danger is Danger.NONE  # the time in which it waited does not count


def test_battery_calls_home_and_then_lands():
    low = flown(Supervisor(), 1.0, lambda s: replace(s, battery=0.2))
    assert all(o.home and not o.land and o.command == AHEAD for o in low)
    empty = Supervisor()
    assert flown(empty, 0.2, lambda s: replace(s, battery=0.08))[-1].land
    assert flown(empty, 0.2, begin_s=0.2)[-1].land  # once it lands, it lands


def test_fence_blocks_outward_commands_only():
    limits = NavLimits(fence_m=2.0)
    out = Supervisor(limits)
    flown(out, 1.0)
    at_fence = lambda s: replace(s, p_w=np.array([2.1, 0.0, 1.1]))  # noqa: E731
    assert flown(out, 0.5, at_fence, begin_s=1.0)[-1].danger is Danger.FENCE
    back = flown(out, 0.5, at_fence, command=VelocityCommand(forward_m_s=-0.3), begin_s=1.5)
    assert back[-1].danger is Danger.NONE


def test_no_state_hovers():
    order = Supervisor().order(0.0)
    assert order.command.sticks() == (0.0, 0.0, 0.0, 0.0) and not order.land


def test_heights_are_kept():
    limits = NavLimits(lowest_m=0.5, highest_m=1.5)
    rising = flown(
        Supervisor(limits), 0.5, lambda s: replace(s, p_w=np.array([0, 0, 1.6])), command=VelocityCommand(up_m_s=0.3)
    )
    assert rising[-1].command.up_m_s == 0.0
    sinking = flown(
        Supervisor(limits), 0.5, lambda s: replace(s, p_w=np.array([0, 0, 0.4])), command=VelocityCommand(up_m_s=-0.3)
    )
    assert sinking[-1].command.up_m_s == 0.0
    assert math.isclose(flown(Supervisor(limits), 0.5, command=VelocityCommand(up_m_s=0.3))[-1].command.up_m_s, 0.3)


def test_uncertain_scale_lands_later():
    orders = flown(Supervisor(), UNSURE_LAND_S + 1.0, lambda s: replace(s, metric=False, p_w=np.array([0.0, 0.0, 1.1])))
    assert not any(o.land for o in orders[: round(20 * UNSURE_LAND_S) - 1]) and orders[-1].land
    up = [o.command.up_m_s for o in orders[:-30]]
    assert min(up) < 0 < max(up) and abs(sum(up)) < 41 * max(up), "up and down about where it was"


def test_stale_frame_after_uncertain_scale_does_not_land_at_once():
    supervisor = Supervisor()
    flown(supervisor, 12.0, lambda s: replace(s, scale_sigma=0.3))
    late = flown(supervisor, 1.0, lambda s: replace(s, seen_s=s.stamp_s - 1.0), begin_s=12.0)
    assert {o.danger for o in late} == {Danger.BLIND} and not any(o.land for o in late)


def test_alternating_dangers_land():
    supervisor = Supervisor()

    def turns(s):
        return replace(s, scale_sigma=0.3) if int(s.stamp_s) % 2 else replace(s, seen_s=s.stamp_s - 1.0)

    orders = flown(supervisor, UNSURE_LAND_S + 1.0, turns)
    assert not orders[round(20 * (LAND_S + 2.0))].land and orders[-1].land


def test_reported_height_replaces_non_metric_map_height():
    def low_by_a_map(s):
        return replace(s, metric=False, p_w=np.array([0.0, 0.0, 0.3]), reported_height_m=2.0)

    up = [o.command.up_m_s for o in flown(Supervisor(), 8.0, low_by_a_map)]
    assert max(up) <= 0.0 and min(up) < -0.1, "2 m by its own word: down, whatever the map calls 0.3"


def test_height_conflict_stops_the_drone():
    """At a wall without corners the pose sank by 0.5 m while the drone rose by 0.9 m, every frame tracked."""
    supervisor = Supervisor()
    flown(supervisor, 2.0, lambda s: replace(s, reported_height_m=1.4))
    orders = flown(supervisor, LAND_S + 2.0, lambda s: replace(s, reported_height_m=1.7), command=AHEAD, begin_s=2.0)
    assert orders[10].danger is Danger.NONE, "a picture that is late in a climb"
    assert orders[30].danger is Danger.HEIGHT_CONFLICT
    assert all(o.command.sticks()[:2] == (0.0, 0.0) for o in orders[30:]), "by a pose that is wrong no way leads back"
    assert orders[-1].land


def test_no_height_conflict_while_scale_is_uncertain():
    orders = flown(Supervisor(), 3.0, lambda s: replace(s, reported_height_m=1.9, scale_sigma=0.2))
    assert {o.danger for o in orders} == {Danger.SCALE}


def test_neither_height_may_be_beyond_the_limits():
    """The map says 1.2 m, the drone 2.0 m: it may sink but not rise."""
    rising = flown(Supervisor(), 0.5, lambda s: replace(s, reported_height_m=2.0), command=VelocityCommand(up_m_s=0.3))
    assert all(o.command.up_m_s == 0.0 for o in rising)
    sinking = flown(
        Supervisor(), 0.5, lambda s: replace(s, reported_height_m=2.0), command=VelocityCommand(up_m_s=-0.3)
    )
    assert all(o.command.up_m_s == -0.3 for o in sinking)


def test_blocked_way_back_is_given_up_and_reported():
    """It backs up by .25 m/s for a second and a half, and its own velocities say that it stands."""
    supervisor = Supervisor()
    flown(supervisor, 3.0)
    here = {"p_w": np.array([1.5, 0.0, 1.1]), "velocity_w": np.array([0.02, 0.0, 0.0]), "tracked": False}
    lost = flown(
        supervisor, 9.0, lambda s: replace(s, **here, position_sigma_m=0.2), begin_s=3.0, command=VelocityCommand()
    )
    backing = [o.command.why.endswith("back up along the path flown") for o in lost]
    assert sum(backing) / 20 == pytest.approx(1.55, abs=0.1)
    (contact,) = [o.contact for o in lost if o.contact is not None]
    np.testing.assert_allclose(contact.towards_w, [-1.0, 0.0], atol=0.2)
    assert not any(o.land for o in lost)


def test_scale_change_is_no_dead_reckoned_distance():
    """Carried by half a metre, which become a whole one: it backs up by 2 m, in 8 s, not by 3.5."""
    supervisor = Supervisor()
    flown(supervisor, 2.0)
    flown(supervisor, 1.0, lambda s: replace(s, tracked=False, position_sigma_m=0.1), begin_s=2.0, x=1.0)
    supervisor.views.correct(longer(2.0))
    there = {"p_w": np.array([2.95, 0.0, 2.2]), "velocity_w": BACK, "tracked": False, "position_sigma_m": 0.2}
    lost = flown(supervisor, 11.0, lambda s: replace(s, **there), command=VelocityCommand(), begin_s=3.0)
    backing = [o.command.why.endswith("back up along the path flown") for o in lost]
    assert sum(backing) / 20 == pytest.approx(8.0, abs=0.3)


def test_way_back_follows_map_corrections():
    """Metres become twice as long: the drone that was 1.5 m from its start is 3 m away, and backs up."""
    supervisor = Supervisor()
    flown(supervisor, 3.0)
    supervisor.views.correct(longer(2.0))
    blind = flown(
        supervisor,
        4.0,
        lambda s: replace(s, p_w=np.array([2.95, 0.0, 2.2]), velocity_w=np.zeros(3), seen_s=2.6),
        command=VelocityCommand(),
        begin_s=3.0,
    )
    assert blind[60].command.forward_m_s < -0.1
