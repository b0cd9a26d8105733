"""Verbs and their outcomes, over a vehicle that follows orders exactly, in a room that its pilot has seen."""

import math

import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.flying.navigator import DEAD_RECKONING, UNCERTAIN, UNRELATED, Navigator
from edgeslam_torch.flying.result import FlightRefused
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.skills.skill import NO_WAY, Result, Skill

TICK_S = 0.05
WALL_M = 4.0


class ObedientVehicle:
    """Follows commands at once, in front of a wall at x = `WALL_M` that it sees when it looks there; free elsewhere.

    ``door``: the wall is at 2.5 m, from -2 to 2, with a doorway of 0.9 m, and behind it is another at `WALL_M` + 2.
    """

    def __init__(self, flight_controller, metric=True, battery=1.0, door=False):
        self.door = door
        self.flight_controller, self.camera, self.over = flight_controller, PRESETS["tello"], ""
        self.flying, self.battery, self.metric, self.ticks = False, battery, metric, 0
        self.p, self.yaw, self.v, self.now_s = np.array([0.0, 0.0, 0.1]), 0.0, np.zeros(3), 0.0

    def take_off(self):
        self.flying, self.p[2] = True, 0.9

    def fly(self, until):
        while self.flying and not until():
            self.now_s += TICK_S
            self.ticks += 1
            self.p = self.p + TICK_S * self.v
            state = DroneState(
                self.now_s, self.p, self.yaw, self.v, metric=self.metric, battery=self.battery, view=self._view()
            )
            self.flight_controller.plan(state)
            order = self.flight_controller.order(state)
            if order.land:
                self.land(order.command.why)
            w, (c, s) = order.command, (math.cos(self.yaw), math.sin(self.yaw))
            self.v = np.array([c * w.forward_m_s - s * w.left_m_s, s * w.forward_m_s + c * w.left_m_s, w.up_m_s])
            self.yaw += TICK_S * w.turn_left_rad_s

    def land(self, why):
        if self.flying:
            self.flying, self.over = False, why

    def close(self):
        self.land("the program left")

    def _view(self):
        if self.ticks % 4:  # five a second, as in flight
            return None
        turn = np.eye(4)
        turn[:2, :2] = [[math.cos(self.yaw), -math.sin(self.yaw)], [math.sin(self.yaw), math.cos(self.yaw)]]
        turn[:3, 3] = self.p
        T = turn @ camera_on_body()
        K = np.array([[77.0, 0.0, 39.5], [0.0, 77.0, 29.5], [0.0, 0.0, 1.0]])
        u, v = np.meshgrid(np.arange(80), np.arange(60))
        rays = np.stack([(u - 39.5) / 77.0, (v - 29.5) / 77.0, np.ones(u.shape)], -1) @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            to_wall = self._to_wall(T, rays)
            to_floor = np.where(rays[..., 2] < -1e-6, -T[2, 3] / rays[..., 2], 20.0)
        depth = np.minimum(np.minimum(to_wall, to_floor), 20.0).astype(np.float32)
        return View(self.now_s, depth, np.full(depth.shape, 0.01, np.float32), K, T)

    def _to_wall(self, T, rays):
        def to(x):
            away = (x - T[0, 3]) / rays[..., 0]
            return np.where((rays[..., 0] > 1e-6) & (away > 0), away, 20.0)

        if not self.door:
            return to(WALL_M)
        across = T[1, 3] + to(2.5) * rays[..., 1]
        return np.where((np.abs(across) < 2.0) & (np.abs(across) > 0.45), to(2.5), to(WALL_M + 2.0))


def navigator(allow_motion=True, **vehicle):
    flight_controller = FlightController(NavLimits())
    return Navigator(ObedientVehicle(flight_controller, **vehicle), flight_controller, allow_motion)


@pytest.mark.parametrize(
    ("tracked", "apart_m", "reason"),
    [
        (True, 0.0, "home"),
        (False, 0.0, f"home, {DEAD_RECKONING}"),
        (False, 0.3, f"home, {DEAD_RECKONING}"),
        (True, 0.31, f"home, {UNCERTAIN.format(0.31)}"),
        (True, math.inf, f"home, {UNRELATED}"),
    ],
)
def test_an_outcome_says_what_it_rests_on(tracked, apart_m, reason):
    nav = navigator()
    nav.vehicle.flying, nav.vehicle.fly = True, lambda until: None
    nav.flight_controller.state = DroneState(
        9.0, np.zeros(3), 0.0, np.zeros(3), tracked=tracked, submap_sigma_m=apart_m
    )
    nav.flight_controller.result = lambda: Result(True, "home")
    outcome = nav.fly(Skill())
    assert (outcome.reached, outcome.reason) == (True, reason)
    nav.flight_controller.result = lambda: NO_WAY
    assert nav.explore(60.0).reason == NO_WAY.reason, "a failure rests on nothing"


def test_a_landing_that_was_ordered_on_the_ground_is_none_of_the_next_flight():
    nav = navigator()
    nav.flight_controller.land("by the keyboard")
    assert nav.take_off().reached and nav.vehicle.flying


def test_a_landing_that_is_ordered_during_the_take_off_is_obeyed():
    nav = navigator()
    rise = nav.vehicle.take_off
    nav.vehicle.take_off = lambda: (rise(), nav.flight_controller.land("by the keyboard"))
    assert not nav.take_off().reached and nav.vehicle.over == "by the keyboard"


@pytest.mark.slow
def test_there_and_back_with_outcomes():
    with navigator() as nav:
        assert nav.take_off().reached
        there = nav.go_to((2.5, 0.5, 1.15))
        assert there.reached and there.reason == "there"
        assert np.linalg.norm(nav.vehicle.p[:2] - [2.5, 0.5]) < 0.25
        assert 2.2 < there.path_m < 4.0
        assert there.min_clearance_m == pytest.approx(WALL_M - nav.vehicle.p[0] - 0.1, abs=0.25)
        home = nav.return_home()
        assert home.reached and np.linalg.norm(nav.vehicle.p[:2]) < 0.2
        landed = nav.land()
        assert landed.reached and not nav.vehicle.flying


def test_goals_in_the_wall_are_refused_and_it_stays_in_the_air():
    with navigator() as nav:
        nav.take_off()
        with pytest.raises(FlightRefused, match="obstacle"):
            nav.go_to((WALL_M + 0.05, 0.0, 1.15))
        assert nav.vehicle.flying
    assert nav.vehicle.over == "the program left"


def test_without_metric_scale_goals_are_refused_and_take_off_lands():
    with navigator(metric=False) as nav:
        nav.vehicle.take_off()
        nav.flight_controller.order(DroneState(0.0, nav.vehicle.p, 0.0, np.zeros(3), metric=False))
        with pytest.raises(FlightRefused, match="no metric scale yet"):
            nav.go_to((1.0, 0.0, 1.15))
    with navigator(metric=False) as nav:
        outcome = nav.take_off()
        assert not outcome.reached and "no metric scale" in outcome.reason and not nav.vehicle.flying


@pytest.mark.slow
def test_a_low_battery_brings_it_home_and_down():
    with navigator() as nav:
        nav.take_off()
        nav.go_to((2.0, 0.0, 1.15))
        nav.vehicle.battery = 0.2
        outcome = nav.go_to((2.0, 2.0, 1.15))
        assert not outcome.reached and "battery low" in outcome.reason
        assert not nav.vehicle.flying and np.linalg.norm(nav.vehicle.p[:2]) < 0.2
        with pytest.raises(FlightRefused, match="has ended"):
            nav.take_off()


def test_exploring_ends_in_time():
    with navigator() as nav:
        nav.take_off()
        begin = nav.vehicle.now_s
        assert nav.explore(5.0).reached
        assert 5.0 <= nav.vehicle.now_s - begin < 5.5
        with pytest.raises(FlightRefused, match="more than 0"):
            nav.explore(float("nan"))


@pytest.mark.slow
def test_an_exit_is_found_and_flown_through():
    with navigator(door=True) as nav:
        with pytest.raises(FlightRefused, match="take off first"):
            nav.find_exits()
        nav.take_off()
        found = nav.find_exits(60.0)
        assert found.reached and found.reason == "an exit was found"
        exit_ = nav.exits()[0]
        assert exit_.centre_w[:2] == pytest.approx([2.5, 0.0], abs=0.15)
        assert exit_.width_m == pytest.approx(0.9, abs=0.15)
        through = nav.go_through(exit_)
        assert through.reached and through.reason == "through the exit"
        assert nav.vehicle.p[:2] == pytest.approx([3.3, 0.0], abs=0.35)


def test_nothing_ahead_is_no_corridor():
    with navigator() as nav:
        nav.take_off()
        outcome = nav.follow_corridor(0.5)
        assert not outcome.reached and outcome.reason == "there is no corridor here"
        with pytest.raises(FlightRefused, match="more than 0"):
            nav.follow_corridor(0.0)


@pytest.mark.parametrize("location", ["sim://nowhere", "sim://corridor:x", "sim://corridor:-1", "tello://a b"])
def test_addresses_that_mean_nothing(location):
    with pytest.raises(SourceError):
        Navigator.open(location)
