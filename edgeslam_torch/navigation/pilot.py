"""Decides, at every moment, how to move towards a task through what is known to be free."""

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.arcs import Arcs, candidates
from edgeslam_torch.navigation.contact.losses import Losses
from edgeslam_torch.navigation.drone_state import HOVER, Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import ExitTracker
from edgeslam_torch.navigation.openings.wall_frame import Walls
from edgeslam_torch.navigation.route import CostToGo, cost_to_go
from edgeslam_torch.navigation.space import CELL_M, Space
from edgeslam_torch.navigation.speed_dither import dithered
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.navigation.tasks import Task
from edgeslam_torch.types import FloatArray

BAND_M = 0.05
"""Free height above and below the drone's hull."""
TAKE_OFF_M = 0.5
"""Radius that a person leaves free around a drone that takes off."""
_LOOK_M = 0.25
"""Rise above the height of flight from which a camera that is tilted down sees what is at that height before it."""
_SWEEP_RAD = math.radians(45.0)
"""Turn to each side there: a camera of 55 degrees does not see the sides of the way just before it."""
_SEARCH_RAD, _SEARCH_S = math.radians(60.0), 8.0
"""Turn to each side of the goal where no way is known, and time of a turn there and back: 30 degrees a second."""
_BESIDE_M = 0.6
"""How near to a goal that seems to lie in a solid it flies: what is said to be there may be a speck, seen from afar."""
_AHEAD_RAD = math.radians(10.0)
"""Turn within which it still looks ahead."""
_REPLAN_S = 0.5
_AHEAD_M = 0.8
"""Way ahead that the drone turns to."""
_FACING_RAD = math.radians(30.0)
"""Beyond it the drone turns before it flies: it does not fly where it does not look."""
_SIDEWAYS = 0.3
"""Share of the speed with which it moves where it does not look, through what it saw before."""
_SQUEEZE = 0.6
"""Share of the speed with which it passes the unseen at a hull's distance."""
_GAIN_M = 0.04
"""Least progress of a movement, in metres of way."""
_MOVES_S = 1.0
"""Time within which a view should come after a revision of metres, five a second being usual."""
_PATIENCE_S = 1.0
"""Time in which a look must show a way; then it rises for another view."""
_LEVEL_S = 40.0
"""Time after which a look around is given up: it takes 12 s, and metres are waited for up to 20 s more."""
_LOST_S = 15.0
"""Time without progress, two looks left and right, after which what closes the way is doubted and looked at anew; the
next time, the task is given up."""
_LOST_M = 1.5
"""Distance within which losses of the pose are about one place."""
_DITHERS_S = 5.0
"""Time without progress after which movements to and fro have shown all that they can: it rises for another view."""
_ELSEWHERE_M = 0.5
"""Way that counts as progress: what is to go may grow when a way turns out to be closed."""
_NARROW_AHEAD_M = 2.0
"""Way ahead in which a gap that is too narrow is what a look was for."""
_WANTED_M = 0.45
"""Clearance that is wanted where there is space for it."""
_UPRIGHT_M, _UPRIGHT_SHARE = (0.7, 1.5), 0.7
"""Heights that a camera at the height of flight sees of a wall two metres away, and how much of them a wall fills."""


class Phase(StrEnum):
    """What the pilot is doing."""

    RISING = "rising to look"
    SWEEPING = "looking left and right"
    SINKING = "sinking to the height of flight"
    FLYING = "flying"
    DONE = "done"
    STUCK = "no way"


@dataclass(slots=True)
class Pilot:
    """Flies one task at a time; a new task may be given at any moment."""

    task: Task
    limits: NavLimits = field(default_factory=NavLimits)
    space: Space = field(default_factory=Space)
    phase: Phase = Phase.RISING
    layer: Layer | None = None
    """The last layer, for pictures."""
    way_w: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """The last way, for pictures."""
    exits: ExitTracker = field(default_factory=ExitTracker)
    """What was found of exits on the way, whatever the task."""
    _plan: CostToGo | None = None
    _goals: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))
    """Cells ``(G, 2)`` that it leads to."""
    _planned_s: float = -math.inf
    _progress_s: float = math.nan
    """When the cost to go was last less than ever; time of first looks, and in which it was overridden, is left out."""
    _updated_s: float = math.nan
    """When it took in the last state."""
    _least: float = math.inf
    """The least cost to go; NaN where the map has moved since it was known."""
    _progress_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    """``(2,)`` where it was then."""
    _waiting_s: float = math.nan
    """Since when there is nothing to fly into."""
    _revision: int = 0
    _revised_s: float = -math.inf
    """When its metres were last those of the states."""
    _level_s: float = math.nan
    """Since when it looks around."""
    _sweep: list[float] = field(default_factory=list)
    """Headings still to be looked at, last first."""
    _tries_narrow: bool = True
    """Whether gaps that are too narrow are worth a look: until one was in vain."""
    _looked_w: FloatArray | None = None
    """``(2,)`` where a look showed no way last."""
    _looks_again: bool = False
    """Whether the present look is another one from about the same place, which counts as lack of progress."""
    _doubted_w: FloatArray | None = None
    """``(2,)`` where it doubted what closed its way last."""
    _losses: Losses = field(default_factory=lambda: Losses(_LOST_M))
    """Of the pose, since the task began."""
    _submap: int = 0
    """Piece of map that it is in."""
    _submap_s: float = -math.inf
    """When the first picture in it was taken; minus infinity once what was seen before has been forgotten."""

    def begin(self, task: Task) -> None:
        """Fly something else from now on."""
        self.task, self.phase = task, Phase.FLYING
        self._plan, self._planned_s, self._tries_narrow, self._doubted_w = None, -math.inf, True, None
        self._progress_s, self._least, self._waiting_s = math.nan, math.inf, math.nan
        self._losses = Losses(_LOST_M)

    def walls(self) -> Walls:
        """What is known at the height of flight, and what of it stands upright."""
        layer = self.space.layer(self.limits.height_m, self.limits.radius_m + BAND_M)
        return Walls(layer, self.space.upright(*_UPRIGHT_M, _UPRIGHT_SHARE))

    def why_stuck(self) -> str:
        """What keeps it from going on, in words, once it is `Phase.STUCK`."""
        return "its pose is lost there again and again" if self._gives_up() else str(Phase.STUCK)

    def _gives_up(self) -> bool:
        return self.task.gives_up(self._losses.count)

    def add_contact(self, contact: Contact) -> None:
        """Something holds it that no view shows: not there again."""
        self.space.add_contact(contact, self.limits.radius_m + 0.5 * CELL_M)
        self._plan = None

    def update(self, state: DroneState) -> VelocityCommand:
        """Take in what is seen, and decide.

        Raises:
            ValueError: If the position or the velocity is not finite.
        """
        if not (np.isfinite(state.p_w).all() and np.isfinite(state.velocity_w).all()):
            raise ValueError("a pilot needs to know where the drone is, and how fast")
        if state.revision != self._revision and state.map_update is None and state.stamp_s - self._revised_s < _MOVES_S:
            return VelocityCommand(why="its metres were revised: wait for a view in the new ones")
        self._take_in(state)
        looks = self.phase in (Phase.RISING, Phase.SWEEPING, Phase.SINKING)
        if state.overridden or (looks and not self._looks_again):  # that is no lack of progress
            self._progress_s += state.stamp_s - self._updated_s
        self._updated_s = state.stamp_s
        if looks:
            return self._level(state)
        self._level_s = math.nan
        if self.phase in (Phase.DONE, Phase.STUCK):
            return self._at_height(state, HOVER)
        self._losses.note(state)
        if self.task.done(state):
            self.phase = Phase.DONE
            return self._at_height(state, HOVER)
        if self._gives_up():
            self.phase = Phase.STUCK
            return self._at_height(state, HOVER)
        return self._at_height(state, self._fly(state))

    def _take_in(self, state: DroneState) -> None:
        if state.map_update is not None:
            self._carry(state.map_update)
        elif state.revision != self._revision:
            self._forget()
        self._revision, self._revised_s = state.revision, state.stamp_s
        self._check_submap(state)
        if math.isnan(self._progress_s):
            self._progress_s = self._updated_s = state.stamp_s
            if self.phase is Phase.RISING:
                for z in np.arange(0.1, self.limits.height_m + _LOOK_M, 0.2):
                    self.space.flown(np.array([*state.p_w[:2], z]), TAKE_OFF_M)
        self.space.follow(state.p_w)
        if state.view is not None:
            self.space.observe(state.view)
        self.space.flown(state.p_w, self.limits.radius_m + BAND_M)
        if self.exits.due(state):
            self.exits.look(self.walls(), state)
            self.task.consider(self.exits.candidates, self.exits.exits)

    def _carry(self, update: MapUpdate) -> None:
        """Bring what is known along with the map that moved; that is no progress."""
        self.space.rebuild(update)
        self.exits.carry(update)
        self.task.carry(update)
        self._losses.carry(update)
        if self._looked_w is not None:
            self._looked_w = update.points(self._looked_w[None])[0]
        if self._doubted_w is not None:
            self._doubted_w = update.points(self._doubted_w[None])[0]
        self._plan, self._least = None, math.nan
        self._progress_w = update.points(self._progress_w[None])[0]

    def _check_submap(self, state: DroneState) -> None:
        """What was seen in other pieces of map counts as long as it is known where they lie to this one."""
        if state.submap != self._submap:
            self._submap, self._submap_s = state.submap, state.stamp_s - state.blind_s
        if state.submap_sigma_m > DEAD_RECKONING_SIGMA_M and self._submap_s > -math.inf:
            self.space.forget_before(self._submap_s)
            self._plan, self._least, self._submap_s = None, math.nan, -math.inf
            self._looked_w = self._doubted_w = None

    def _forget(self) -> None:
        """Begin anew: nothing says how what is known relates to the new metres."""
        self.space, self.exits = Space(), ExitTracker()
        self._plan, self._least, self._progress_s = None, math.inf, math.nan
        self.phase = Phase.RISING

    def _level(self, state: DroneState) -> VelocityCommand:
        """Rise above the height of flight, look left and right, and come back to it."""
        low, high = self.limits.height_m, self.limits.height_m + _LOOK_M
        if math.isnan(self._level_s):
            self._level_s = state.stamp_s
        if state.stamp_s - self._level_s > _LEVEL_S:
            self.phase = Phase.STUCK
            return HOVER
        if self.phase is Phase.RISING and state.p_w[2] > high - 0.06:
            self.phase = Phase.SWEEPING
            self._sweep = [state.yaw_rad + side * _SWEEP_RAD for side in (0.0, 1.0, -1.0)]
        if self.phase is Phase.SWEEPING:
            self._sweep = self._worth_a_look(state)
            error = float(wrapped(np.array(self._sweep[-1] - state.yaw_rad)))
            if abs(error) < math.radians(8.0):
                self._sweep.pop()
            if self._sweep:
                return VelocityCommand(0.0, 0.0, self._climb(high - state.p_w[2]), self._turn(error), str(self.phase))
            self.phase = Phase.SINKING
        if self.phase is Phase.SINKING and state.p_w[2] < low + 0.06:
            self.phase, self._waiting_s = Phase.FLYING, math.nan
        target = high if self.phase is Phase.RISING else low
        return VelocityCommand(up_m_s=self._climb(target - state.p_w[2]), why=str(self.phase))

    def _worth_a_look(self, state: DroneState) -> list[float]:
        """Headings of the sweep but those on the side where the pose was lost: a wall that shows nothing."""
        ahead = self._sweep[0]
        off = wrapped(np.array([state.yaw_rad - ahead, *(h - ahead for h in self._sweep)]))
        if state.tracked or abs(off[0]) < _AHEAD_RAD:
            return self._sweep
        return [h for h, side in zip(self._sweep, off[1:], strict=True) if side * off[0] < 1e-9]

    def _turn(self, error_rad: float) -> float:
        return float(np.clip(2.0 * error_rad, -self.limits.turn_rad_s, self.limits.turn_rad_s))

    def _climb(self, error_m: float) -> float:
        return float(np.clip(1.5 * error_m, -self.limits.climb_m_s, self.limits.climb_m_s))

    def _at_height(self, state: DroneState, command: VelocityCommand) -> VelocityCommand:
        # A pose that telemetry carries drifts in height, too: by velocities that are cut off. The drone measures it.
        dead_reckoning = not state.tracked and math.isfinite(state.reported_height_m)
        up = self._climb(self.limits.height_m - (state.reported_height_m if dead_reckoning else float(state.p_w[2])))
        return VelocityCommand(command.forward_m_s, command.left_m_s, up, command.turn_left_rad_s, command.why)

    def _fly(self, state: DroneState) -> VelocityCommand:
        heading = self.task.heading_rad(state)
        if heading is not None:
            self._progress_s = state.stamp_s
            return VelocityCommand(
                turn_left_rad_s=self._turn(float(wrapped(np.array(heading - state.yaw_rad)))),
                why="stand and look where the task wants",
            )
        plan = self._planned(state)
        here = state.p_w[:2]
        now = float(plan.at(here))
        if math.isnan(self._least):
            self._least = now
        if now < self._least - 0.1 or float(np.linalg.norm(here - self._progress_w)) > _ELSEWHERE_M:
            self._least, self._progress_s = min(now, self._least), state.stamp_s
            self._progress_w = here.copy()
        elif (stands_s := state.stamp_s - self._progress_s) > _LOST_S:
            self._start_over(state)
            return HOVER
        elif stands_s > _DITHERS_S and math.isfinite(now) and state.tracked and not _about(self._looked_w, here):
            self._rise(state)
            return HOVER
        if not math.isfinite(now):
            return VelocityCommand(turn_left_rad_s=self._search(state), why="no way is known: look around")
        self.way_w = plan.way(here, 3.0)
        ahead, faced = self._bearing(here), self.task.faces_rad(state)
        error = float(wrapped(np.array((ahead if faced is None else faced) - state.yaw_rad)))
        turn = self._turn(error)
        chosen = self._chosen(state, plan, ahead, error)
        if chosen is None:
            return self._look(state, error, turn)
        self._waiting_s = math.nan
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        return VelocityCommand(c * chosen[0] + s * chosen[1], c * chosen[1] - s * chosen[0], 0.0, turn, "along the way")

    def _is_narrow(self, state: DroneState) -> bool:
        """Whether the way just ahead is narrower than it flies through."""
        assert self.layer is not None
        ahead = self.way_w[: round(_NARROW_AHEAD_M / CELL_M)]
        need = self.limits.clearance_m(state.position_sigma_m) - 0.5 * CELL_M
        return bool((self.layer.from_solid_at(ahead) <= need).any())

    def _search(self, state: DroneState) -> float:
        """Rate of turn [rad/s] that looks left and right of where the goal is; all around if it is nowhere.

        A full turn would leave behind all that it knows, and what hides the way is between it and the goal.
        """
        assert self._plan is not None
        if len(self._goals) == 0:
            return 0.5 * self.limits.turn_rad_s
        step = self._plan.layer.centres(self._goals).mean(axis=0) - state.p_w[:2]
        side = 4.0 * abs(state.stamp_s / _SEARCH_S % 1.0 - 0.5) - 1.0
        wanted = math.atan2(step[1], step[0]) + side * _SEARCH_RAD
        return self._turn(float(wrapped(np.array(wanted - state.yaw_rad))))

    def _planned(self, state: DroneState) -> CostToGo:
        """The plan, made anew when it is half a second old."""
        half = self.limits.radius_m + BAND_M
        self.layer = self.space.layer(self.limits.height_m, half)
        if self._plan is None or state.stamp_s - self._planned_s >= _REPLAN_S:
            self._goals = self.task.goals(self.layer, state)
            need, here = self.limits.clearance_m(state.position_sigma_m), self.layer.cells(state.p_w[:2])
            narrow = self._hull_m(state) if self._tries_narrow else math.inf
            self._plan = cost_to_go(self.layer, self._goals, need, here, _BESIDE_M, narrow)
            self._planned_s = state.stamp_s
        return self._plan

    def _bearing(self, here: FloatArray) -> float:
        """Direction of the way, `_AHEAD_M` ahead."""
        far = self.way_w[min(len(self.way_w) - 1, round(_AHEAD_M / 0.1))] - here
        return math.atan2(far[1], far[0])

    def _chosen(self, state: DroneState, plan: CostToGo, ahead: float, error: float) -> FloatArray | None:
        """Velocity ``(2,)`` in the world of the best candidate; None when standing is as good."""
        assert self.layer is not None
        fastest = dithered(self.limits.speed_m_s, state.stamp_s)
        here, blind = state.p_w[:2], not state.tracked
        arcs = candidates(self.layer, here, state.velocity_w[:2], ahead, self.limits, fastest, blind)
        need = self.limits.clearance_m(state.position_sigma_m)
        standing = float(arcs.clearance_m[0])
        good = arcs.clearance_m >= need
        if standing < need:  # too near already: away from it
            good |= arcs.clearance_m >= standing - 1e-3
        if self._may_squeeze(state.p_w[:2]):
            good |= self._squeezes(arcs, state)
        good |= self._goes_back(arcs, state)
        score = self._score(arcs, plan, state, error)
        score[~good] = np.inf
        best = int(np.argmin(score))
        if best == 0 or not score[best] < score[0] - _GAIN_M:
            return None
        return arcs.velocity_w[best]

    def _may_squeeze(self, here: FloatArray) -> bool:
        """Whether a look from about here showed no way, and what is unseen is not what it has doubted to be solid."""
        return _about(self._looked_w, here) and not _about(self._doubted_w, here)

    def _squeezes(self, arcs: Arcs, state: DroneState) -> np.ndarray:
        """``(C,)`` slow movements that keep their clearance from every solid and only a hull's from the unseen.

        What is beside the drone and nearer than 0.6 m is below its picture or above it: no look from here shows it.
        """
        slow = np.linalg.norm(arcs.velocity_w, axis=1) < _SQUEEZE * self.limits.speed_m_s + 1e-6
        hull = self._hull_m(state)
        away = arcs.from_solid_m >= self.limits.clearance_m(state.position_sigma_m)
        return np.asarray(slow & away & (arcs.clearance_m >= hull))

    def _goes_back(self, arcs: Arcs, state: DroneState) -> np.ndarray:
        """``(C,)`` slow movements along the way that it flew: through a door whose frame was never seen from behind."""
        slow = np.linalg.norm(arcs.velocity_w, axis=1) < _SQUEEZE * self.limits.speed_m_s + 1e-6
        hull = self._hull_m(state)
        passes = (arcs.from_solid_m >= hull + 0.5 * CELL_M) & (arcs.clearance_m >= hull)
        return np.asarray(slow & passes & self.space.was_at(arcs.p_w).all(axis=1))

    def _hull_m(self, state: DroneState) -> float:
        """Distance of the drone's centre from what its hull may be beside."""
        return self.limits.radius_m + 2.0 * state.position_sigma_m

    def _score(self, arcs: Arcs, plan: CostToGo, state: DroneState, error: float) -> FloatArray:
        """Metres to go after each candidate, and what its lack of clearance is worth."""
        score = np.asarray(plan.at(arcs.end_w), dtype=np.float64).copy()
        away = arcs.from_solid_m if self._may_squeeze(state.p_w[:2]) else arcs.clearance_m
        score += 0.5 * np.clip(_WANTED_M - away, 0.0, None)
        speed = np.linalg.norm(arcs.velocity_w, axis=1)
        off = np.abs(wrapped(np.arctan2(arcs.velocity_w[:, 1], arcs.velocity_w[:, 0]) - state.yaw_rad))
        unseen = (off > _FACING_RAD) & (speed > _SIDEWAYS * self.limits.speed_m_s + 1e-6)
        turning = (abs(error) > _FACING_RAD) & (speed > _SIDEWAYS * self.limits.speed_m_s + 1e-6)
        score[unseen | turning] = np.inf
        return score

    def _rise(self, state: DroneState) -> None:
        """See the way from higher."""
        self.phase, self._waiting_s = Phase.RISING, math.nan
        self._looks_again = _about(self._looked_w, state.p_w[:2])
        self._looked_w = state.p_w[:2].copy()
        self._tries_narrow &= not self._is_narrow(state)

    def _start_over(self, state: DroneState) -> None:
        """Doubt what closes the way and look around anew, once about a place: it may be the trace of a wrong depth or
        of a pose that has been put right since. What is unseen is not flown into; but two views through what was solid
        free it now, where it took up to ten, so nothing of it is passed at a hull's distance."""
        if _about(self._doubted_w, state.p_w[:2]) or not state.tracked:
            self.phase = Phase.STUCK
            return
        self.space.doubt_solids()
        self._plan, self._least, self._progress_s = None, math.inf, state.stamp_s
        self._doubted_w, self._looked_w = state.p_w[:2].copy(), None
        self._rise(state)
        self._tries_narrow = True

    def _look(self, state: DroneState, error: float, turn: float) -> VelocityCommand:
        """Turn to where the way goes; if that shows nothing, see it from higher."""
        if abs(error) > math.radians(8.0):
            self._waiting_s = math.nan
            return VelocityCommand(turn_left_rad_s=turn, why="look along the way")
        if math.isnan(self._waiting_s):
            self._waiting_s = state.stamp_s
        elif state.stamp_s - self._waiting_s > _PATIENCE_S and state.tracked:  # else there is no view to come
            self._rise(state)
        return VelocityCommand(turn_left_rad_s=turn, why="wait for a view of the way")


def _about(place_w: FloatArray | None, here: FloatArray) -> bool:
    """Whether a place ``(2,)`` of earlier is this one."""
    return place_w is not None and float(np.linalg.norm(here - place_w)) < _ELSEWHERE_M
