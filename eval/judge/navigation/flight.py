"""One judged flight, in lockstep or over UDP in real time."""

import math
import time
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.drone.emulator.air import Air
from edgeslam_torch.drone.emulator.drone import Contact, DroneModel, Mode
from edgeslam_torch.drone.emulator.lockstep import LockstepTello
from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.eval.judge.navigation.behaviours import BEHAVIOURS, Behaviour, Moment, right_exits
from edgeslam_torch.eval.judge.navigation.flown import Case, Flown
from edgeslam_torch.eval.judge.navigation.perception import (
    DEPTH_SIZE,
    FAULTS,
    IMAGE_SIZE,
    Conditions,
    Perception,
    SlamPerception,
    TruePerception,
    nothing_painted,
)
from edgeslam_torch.eval.metrics.align import travelled
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import BAND_M, Phase
from edgeslam_torch.navigation.route import cost_to_go
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import FloatArray

TICK_S = 1.0 / 15.0
_SAME_EVENT_S = 1.0
"""Contacts closer in time belong to one event: the simulated body bounces every 10 ms at an obstacle."""
_SIGMAS, _NO_HARM_M = 3.0, 0.1
"""Bound of a consistent pose error: standard deviations, plus the hull's radius."""
_FREE_M = 0.6
"""Clearance above which the cruising speed is measured."""
_CELL_M = 0.1
"""Of the true map."""


def fly(case: Case) -> Flown:
    """Fly one case in lockstep.

    Raises:
        ConfigError: If the world is unknown.
    """
    limits, conditions, behaviour = NavLimits(), FAULTS[case.fault], BEHAVIOURS[case.behaviour]
    site, by_slam = named_site(case.world, case.seed), case.perception == "slam"
    wind = np.array([0.0, conditions.wind_m_s, 0.0])
    air = Air(wind, 0.5 * conditions.wind_m_s, np.random.default_rng([case.seed, 1]))
    drone, paint, camera = drone_at(
        site, TELLO_TILT_RAD, IMAGE_SIZE if by_slam else DEPTH_SIZE, conditions.battery, air, ready=False
    )
    tello = LockstepTello(drone, paint if by_slam else nothing_painted, conditions.radio, case.seed)
    perception: Perception = TruePerception(site, drone, conditions)
    if by_slam:
        perception = SlamPerception(camera, conditions, case.seed)
    tasks = _Tasks(site, behaviour, FlightController(limits), conditions.scale)
    found = Flown(case)
    if case.behaviour == "goto":
        take_off_s = 2.5 + (limits.height_m - 0.9) / limits.climb_m_s  # of itself to 0.8 m, then the planner's climb
        found.oracle_s = take_off_s + shortest_m(site, limits) / limits.speed_m_s
    _sum_up(found, site, drone, _fly(tello, perception, tasks, conditions, found), behaviour)
    known = tasks.flight_controller.exits()
    found.exits = [len(site.exits), len(known), right_exits(known, site)]
    return found


def is_beyond(state: DroneState, p_w: FloatArray) -> bool:
    """Whether a pose error exceeds its stated uncertainty: of pose, submap, drift and scale.

    Example:
        >>> state = DroneState(0.0, np.array([3.2, 0.0, 1.0]), 0.0, np.zeros(3), scale_sigma=0.02)
        >>> is_beyond(state, np.array([3.0, 0.0, 1.0])), is_beyond(state, np.array([2.8, 0.0, 1.0]))
        (False, True)
    """
    sigma = math.hypot(state.home_sigma_m, state.scale_sigma * float(np.linalg.norm(state.p_w[:2])))
    return float(np.linalg.norm(state.p_w[:2] - p_w[:2])) > _SIGMAS * sigma + _NO_HARM_M


class _Tasks:
    """Gives the flight controller one skill after the other, however the previous one ended."""

    def __init__(self, site: Site, behaviour: Behaviour, flight_controller: FlightController, scale: float) -> None:
        self.flight_controller, self.limit_s = flight_controller, behaviour.limit_s
        self._site, self._scale, self._steps = site, scale, list(behaviour.steps)
        self._first = True

    def go_on(self, now_s: float) -> None:
        """Set the next skill when the current one has ended; the first is set during the climb."""
        if self._steps and (self._first or self.flight_controller.result() is not None):
            step = self._steps.pop(0)
            self.flight_controller.begin(step(Moment(self._site, now_s, self._scale, self.flight_controller.track())))
            self._first = False

    def over(self) -> bool:
        """Whether all tasks have ended."""
        return self.flight_controller.result() is not None and not self._steps


_Tick = tuple[FloatArray, float, float, float]
"""True position, speed [m/s], clearance [m], and the planner's CPU time [s]."""


def _fly(
    tello: LockstepTello, perception: Perception, tasks: _Tasks, conditions: Conditions, found: Flown
) -> list[_Tick]:
    drone, controller = tello.drone, tasks.flight_controller
    ticks: list[_Tick] = []
    dangers: dict[str, None] = {}
    touches: list[float] = []
    tello.send("takeoff")
    landing = False
    while tello.clock_s < tasks.limit_s:
        events = tello.advance(TICK_S)
        touched = [e for e in events if isinstance(e, Contact)]
        touches += [t.clock_s for t in touched]
        found.crashed |= any(t.crashed for t in touched)
        if drone.mode is Mode.GROUND and tello.clock_s > 2.0:
            break
        state = perception.state(tello.clock_s, events)
        if state.metric:
            found.off[0] += 1
            found.off[1] += is_beyond(state, drone.p_w)
            found.off_m = max(found.off_m, float(np.linalg.norm(state.p_w[:2] - drone.p_w[:2])))
        if drone.mode is not Mode.FLYING or landing:
            continue
        began = time.process_time()
        if not conditions.hung_s[0] <= tello.clock_s < conditions.hung_s[1]:
            tasks.go_on(state.stamp_s)
            controller.plan(state)
        order = controller.order(state)
        cpu_s = time.process_time() - began
        ticks.append((drone.p_w.copy(), float(np.linalg.norm(drone.velocity)), drone.clearance(drone.p_w), cpu_s))
        if order.danger:
            dangers[str(order.danger)] = None
        landing = tasks.over() or order.land
        if landing:
            found.ended, found.time_s = str(controller.pilot.phase if tasks.over() else order.danger), tello.clock_s
            tello.send("land")
        else:
            right, forward, up, clockwise = (round(100 * v) for v in order.command.sticks())
            tello.send(f"rc {right} {forward} {up} {clockwise}")
    found.contacts = contact_events(touches)
    found.landed = drone.mode is Mode.GROUND and not found.crashed
    found.ended = found.ended or ("crash" if found.crashed else "out of time")
    found.time_s = found.time_s or tello.clock_s
    found.dangers = tuple(dangers)
    return ticks


def contact_events(contacts_s: Sequence[float]) -> int:
    """Number of contact events, from ordered contact times [s].

    Example:
        >>> contact_events([3.00, 3.01, 3.02, 3.9, 8.0])
        2
    """
    return sum(1 for k, t in enumerate(contacts_s) if k == 0 or t - contacts_s[k - 1] > _SAME_EVENT_S)


def _sum_up(found: Flown, site: Site, drone: DroneModel, ticks: list[_Tick], behaviour: Behaviour) -> None:
    """Compute the figures from the ticks."""
    if not ticks:
        return
    p, speed, clearance_m, cpu_s = (np.array(column) for column in zip(*ticks, strict=True))
    hull, cpu = clearance_m - NavLimits().radius_m, 1e3 * cpu_s
    found.track_w = np.round(p, 3).tolist()
    found.path_m = float(travelled(p[:, :2])[-1])
    found.distance_m = float(np.linalg.norm(drone.p_w[:2] - site.goal_w[:2]))
    found.home_m = float(np.linalg.norm(drone.p_w[:2]))
    found.reached = found.ended == str(Phase.DONE) and not found.contacts and behaviour.reached(found, site)
    moving = (hull > _FREE_M) & (speed > 0.1)
    found.cruise_m_s = float(np.median(speed[moving])) if moving.any() else float("nan")
    found.clearance_p5_m, found.clearance_min_m = float(np.percentile(hull, 5)), float(hull.min())
    found.cpu_ms, found.cpu_worst_ms = float(np.median(cpu)), float(cpu.max())


def true_layer(site: Site, limits: NavLimits) -> Layer:
    """True layer at the flight height, in the drone's world."""
    corners = np.array([[x, y, 0.0] for x in site.world.bounds_w[:, 0] for y in site.world.bounds_w[:, 1]])
    local = (corners - site.T_site_w[:3, 3]) @ site.T_site_w[:3, :3]
    low = np.floor(local[:, :2].min(0) / _CELL_M) * _CELL_M - _CELL_M
    shape = np.ceil((local[:, :2].max(0) - low) / _CELL_M).astype(int) + 1
    x, y = (low[k] + (np.arange(shape[k]) + 0.5) * _CELL_M for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    half = limits.radius_m + BAND_M
    away = np.min([site.clearance(np.c_[grid, np.full(len(grid), limits.height_m + dz)]) for dz in (-half, 0, half)], 0)
    solid = (away < 0.5 * _CELL_M).reshape(shape)
    return Layer(~solid, solid, low, _CELL_M)


def shortest_m(site: Site, limits: NavLimits) -> float:
    """Length [m] of the shortest path from start to goal in the true map under the planner's limits; infinite if there
    is none."""
    layer, start = true_layer(site, limits), np.zeros(2)
    need_m = limits.clearance_m(0.0)
    plan = cost_to_go(layer, layer.cells(site.goal_w[None, :2]), need_m, need_m, layer.cells(start))
    way = plan.way(start, 100.0)
    return float(travelled(way)[-1]) if np.isfinite(plan.at(start)) else float("inf")
