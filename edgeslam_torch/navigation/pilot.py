"""Planner: computes velocity commands towards a task's goals through known free space."""

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.arcs import Arcs, candidates
from edgeslam_torch.navigation.contact.losses import Losses
from edgeslam_torch.navigation.drone_state import HOVER, Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.navigation.openings.exit_tracker import ExitTracker
from edgeslam_torch.navigation.openings.wall_frame import Walls
from edgeslam_torch.navigation.route import CostToGo, cost_to_go
from edgeslam_torch.navigation.space import CELL_M, Space
from edgeslam_torch.navigation.speed_dither import dithered
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.navigation.tasks import Task
from edgeslam_torch.types import FloatArray

BAND_M = 0.05
"""Required free height above and below the hull."""
TAKE_OFF_M = 0.5
"""Radius around the take-off that the operator keeps clear."""
_LOOK_M = 0.25
"""Rise above the flight height from which the down-tilted camera sees that height ahead."""
_SWEEP_RAD = math.radians(45.0)
"""Turn to each side there: a 55 degree field of view misses the sides of the path."""
_SEARCH_RAD, _SEARCH_S = math.radians(60.0), 8.0
"""Amplitude around the goal's bearing of the search for a path, and its period: 30 deg/s."""
_BESIDE_M = 0.6
"""Distance within which cells beside an occupied goal count as goals: from afar, noise may occupy the goal's cell."""
_AHEAD_RAD = math.radians(10.0)
"""Heading error that counts as facing ahead."""
_REPLAN_S = 0.5
_AHEAD_M = 0.8
"""Look-ahead distance along the path."""
_FACING_RAD = math.radians(30.0)
"""Heading error beyond which the drone turns first: it flies only where the camera looks."""
_SIDEWAYS = 0.3
"""Share of the speed outside the field of view, through space observed before."""
_SQUEEZE = 0.6
"""Share of the speed next to unknown cells at hull distance."""
_GAIN_M = 0.04
"""Minimum reduction of the cost to go by a movement [m]."""
_MOVES_S = 1.0
"""Maximum wait for a view after a scale revision; views come at 5 Hz."""
_PATIENCE_S = 1.0
"""Time in which a view must open the path; then the drone rises for another view."""
_LEVEL_S = 40.0
"""Timeout of a look around: 12 s for the look and up to 20 s for the metric scale."""
_LOST_S = 15.0
"""Time without progress (two looks left and right) after which obstacles are reset and observed anew; the next time the
task is given up."""
_LOST_M = 1.5
"""Distance within which tracking losses belong to one place."""
_DITHERS_S = 5.0
"""Time without progress after which the drone rises for another view."""
_ELSEWHERE_M = 0.5
"""Distance flown that counts as progress even if the cost to go grows, as when a path turns out blocked."""
_NARROW_AHEAD_M = 2.0
"""Distance ahead within which a too narrow gap is attributed to the last look."""
_WANTED_M = 0.45
"""Preferred clearance."""
_UPRIGHT_M, _UPRIGHT_SHARE = (0.7, 1.5), 0.7
"""Heights visible on a wall two metres away, and the occupied share that makes a column a wall."""


class Phase(StrEnum):
    """State of the planner."""

    RISING = "rising to look"
    SWEEPING = "looking left and right"
    SINKING = "sinking to the height of flight"
    FLYING = "flying"
    DONE = "done"
    STUCK = "no way"


@dataclass(slots=True)
class Pilot:
    """Executes one task at a time; a new task may be set at any time."""

    task: Task
    limits: NavLimits = field(default_factory=NavLimits)
    space: Space = field(default_factory=Space)
    phase: Phase = Phase.RISING
    layer: Layer | None = None
    """The last layer, for viewers."""
    way_w: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """The last path, for viewers."""
    exits: ExitTracker = field(default_factory=ExitTracker)
    """Exits found so far, whatever the task."""
    _plan: CostToGo | None = None
    _goals: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), int))
    """Goal cells ``(G, 2)`` of the plan."""
    _planned_s: float = -math.inf
    _progress_s: float = math.nan
    """Time of the last progress; first looks and time while overridden do not count."""
    _updated_s: float = math.nan
    """Time of the last state."""
    _least: float = math.inf
    """Lowest cost to go so far; NaN after a map correction."""
    _progress: Places = field(default_factory=lambda: Places(MapViews(), np.zeros(2)))
    """Position at the last progress."""
    _waiting_s: float = math.nan
    """Since when no free space opens ahead."""
    _revision: int = 0
    _revised_s: float = -math.inf
    """Last time at which the planner's scale was that of the states."""
    _level_s: float = math.nan
    """Start of the current look around."""
    _sweep: list[float] = field(default_factory=list)
    """Remaining headings of the look, last first."""
    _tries_narrow: bool = True
    """Whether too narrow gaps are still inspected; false after one without success."""
    _looked: Places = field(default_factory=Places)
    """Position of the last look without success."""
    _looks_again: bool = False
    """Whether the current look repeats one from the same place; it counts as lack of progress."""
    _doubted: Places = field(default_factory=Places)
    """Position at which obstacles were reset last."""
    _losses: Losses = field(default_factory=lambda: Losses(_LOST_M))
    """Tracking losses since the task began."""
    _submap: int = 0
    """Current submap."""
    _submap_s: float = -math.inf
    """Capture time of its first frame; minus infinity once older views have been dropped."""

    def begin(self, task: Task) -> None:
        """Switch to another task."""
        self.task, self.phase = task, Phase.FLYING
        self._plan, self._planned_s, self._tries_narrow, self._doubted = None, -math.inf, True, Places()
        self._progress_s, self._least, self._waiting_s = math.nan, math.inf, math.nan
        self._losses = Losses(_LOST_M)

    @property
    def views(self) -> MapViews:
        """Views of the map, to which positions are tied."""
        return self.space.map_views

    def walls(self) -> Walls:
        """Layer at the flight height, and which of its occupied cells are upright."""
        layer = self.space.layer(self.limits.height_m, self.limits.radius_m + BAND_M)
        return Walls(layer, self.space.upright(*_UPRIGHT_M, _UPRIGHT_SHARE))

    def why_stuck(self) -> str:
        """Reason of `Phase.STUCK` in words."""
        return "tracking is lost there repeatedly" if self._gives_up() else str(Phase.STUCK)

    def _gives_up(self) -> bool:
        return self.task.gives_up(self._losses.count)

    def add_contact(self, contact: Contact) -> None:
        """Add an obstacle that no view shows."""
        self.space.add_contact(contact, self.limits.radius_m + 0.5 * CELL_M)
        self._plan = None

    def update(self, state: DroneState) -> VelocityCommand:
        """Integrate a state and compute the command.

        Raises:
            ValueError: If the position or the velocity is not finite.
        """
        if not (np.isfinite(state.p_w).all() and np.isfinite(state.velocity_w).all()):
            raise ValueError("position and velocity must be finite")
        if state.revision != self._revision and state.map_update is None and state.stamp_s - self._revised_s < _MOVES_S:
            return VelocityCommand(why="scale revised: waiting for a view")
        state = replace(state, views=self.views)
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
        corrected = state.map_update is not None
        if state.map_update is not None:
            self.space.correct(state.map_update)
            self.exits.expire()
            self._plan, self._least = None, math.nan  # a correction is no progress
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
        elif corrected:  # what it was given lies where the map was
            self.task.consider((), ())

    def _check_submap(self, state: DroneState) -> None:
        """Drop views of other submaps if their position relative to this one is too uncertain."""
        if state.submap != self._submap:
            self._submap, self._submap_s = state.submap, state.stamp_s - state.blind_s
        if state.submap_sigma_m > DEAD_RECKONING_SIGMA_M and self._submap_s > -math.inf:
            self.space.forget_before(self._submap_s)
            self._plan, self._least, self._submap_s = None, math.nan, -math.inf
            self._looked, self._doubted = Places(), Places()

    def _forget(self) -> None:
        """Reset: the relation of the old scale to the new one is unknown."""
        self.space, self.exits = Space(map_views=self.views), ExitTracker()
        self._plan, self._least, self._progress_s = None, math.inf, math.nan
        self.phase = Phase.RISING

    def _level(self, state: DroneState) -> VelocityCommand:
        """Rise above the flight height, look left and right, and descend."""
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
            error = state.turn_to_rad(self._sweep[-1])
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
        """Headings of the sweep without those on the side where tracking was lost: a textureless wall."""
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
        # Dead reckoning by truncated velocities drifts in height; the drone measures its height.
        dead_reckoning = not state.tracked and math.isfinite(state.reported_height_m)
        up = self._climb(self.limits.height_m - (state.reported_height_m if dead_reckoning else float(state.p_w[2])))
        return VelocityCommand(command.forward_m_s, command.left_m_s, up, command.turn_left_rad_s, command.why)

    def _fly(self, state: DroneState) -> VelocityCommand:
        heading = self.task.heading_rad(state)
        if heading is not None:
            self._progress_s = state.stamp_s
            return VelocityCommand(turn_left_rad_s=self._turn(state.turn_to_rad(heading)), why="hover and look")
        plan = self._planned(state)
        here = state.p_w[:2]
        now = float(plan.at(here))
        if math.isnan(self._least):
            self._least = now
        if now < self._least - 0.1 or not self._progress.is_near(here, _ELSEWHERE_M):
            self._least, self._progress_s = min(now, self._least), state.stamp_s
            self._progress = Places(state.views, here)
        elif (stands_s := state.stamp_s - self._progress_s) > _LOST_S:
            self._start_over(state)
            return HOVER
        elif (
            stands_s > _DITHERS_S
            and math.isfinite(now)
            and state.tracked
            and not self._looked.is_near(here, _ELSEWHERE_M)
        ):
            self._rise(state)
            return HOVER
        if not math.isfinite(now):
            return VelocityCommand(turn_left_rad_s=self._search(state), why="no path: look around")
        self.way_w = plan.way(here, 3.0)
        ahead, faced = self._bearing(here), self.task.faces_rad(state)
        error = state.turn_to_rad(ahead if faced is None else faced)
        turn = self._turn(error)
        chosen = self._chosen(state, plan, ahead, error)
        if chosen is None:
            return self._look(state, error, turn)
        self._waiting_s = math.nan
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        return VelocityCommand(
            c * chosen[0] + s * chosen[1], c * chosen[1] - s * chosen[0], 0.0, turn, "along the path"
        )

    def _is_narrow(self, state: DroneState) -> bool:
        """Whether the path just ahead is too narrow to fly through."""
        assert self.layer is not None
        ahead = self.way_w[: round(_NARROW_AHEAD_M / CELL_M)]
        need = self.limits.clearance_m(state.position_sigma_m) - 0.5 * CELL_M
        return bool((self.layer.from_solid_at(ahead) <= need).any())

    def _search(self, state: DroneState) -> float:
        """Yaw rate [rad/s] of a search left and right of the goal's bearing; a full turn without goals.

        A full turn would leave the mapped view, and the blocking obstacle lies towards the goal.
        """
        assert self._plan is not None
        if len(self._goals) == 0:
            return 0.5 * self.limits.turn_rad_s
        step = self._plan.layer.centres(self._goals).mean(axis=0) - state.p_w[:2]
        side = 4.0 * abs(state.stamp_s / _SEARCH_S % 1.0 - 0.5) - 1.0
        wanted = math.atan2(step[1], step[0]) + side * _SEARCH_RAD
        return self._turn(state.turn_to_rad(wanted))

    def _planned(self, state: DroneState) -> CostToGo:
        """The plan, updated every `_REPLAN_S`."""
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
        """Bearing of the path at `_AHEAD_M` ahead."""
        far = self.way_w[min(len(self.way_w) - 1, round(_AHEAD_M / 0.1))] - here
        return math.atan2(far[1], far[0])

    def _chosen(self, state: DroneState, plan: CostToGo, ahead: float, error: float) -> FloatArray | None:
        """World velocity ``(2,)`` of the best candidate; None if hovering is as good."""
        assert self.layer is not None
        fastest = dithered(self.limits.speed_m_s, state.stamp_s)
        here, blind = state.p_w[:2], not state.tracked
        arcs = candidates(self.layer, here, state.velocity_w[:2], ahead, self.limits, fastest, blind)
        need = self.limits.clearance_m(state.position_sigma_m)
        standing = float(arcs.clearance_m[0])
        good = arcs.clearance_m >= need
        if standing < need:  # already too close: allow moves that increase the clearance
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
        """Whether a look from here did not open the path, and unknown cells are not obstacles that were reset."""
        return self._looked.is_near(here, _ELSEWHERE_M) and not self._doubted.is_near(here, _ELSEWHERE_M)

    def _squeezes(self, arcs: Arcs, state: DroneState) -> np.ndarray:
        """``(C,)`` slow moves with full clearance to obstacles, but only hull distance to unknown cells.

        Cells within 0.6 m beside the drone lie outside the vertical field of view, so no look from here resolves them.
        """
        slow = np.linalg.norm(arcs.velocity_w, axis=1) < _SQUEEZE * self.limits.speed_m_s + 1e-6
        hull = self._hull_m(state)
        away = arcs.from_solid_m >= self.limits.clearance_m(state.position_sigma_m)
        return np.asarray(slow & away & (arcs.clearance_m >= hull))

    def _goes_back(self, arcs: Arcs, state: DroneState) -> np.ndarray:
        """``(C,)`` slow moves along the path flown, as through a door whose frame was never seen from behind."""
        slow = np.linalg.norm(arcs.velocity_w, axis=1) < _SQUEEZE * self.limits.speed_m_s + 1e-6
        hull = self._hull_m(state)
        passes = (arcs.from_solid_m >= hull + 0.5 * CELL_M) & (arcs.clearance_m >= hull)
        return np.asarray(slow & passes & self.space.was_at(arcs.p_w).all(axis=1))

    def _hull_m(self, state: DroneState) -> float:
        """Hull radius plus two standard deviations of the position [m]."""
        return self.limits.radius_m + 2.0 * state.position_sigma_m

    def _score(self, arcs: Arcs, plan: CostToGo, state: DroneState, error: float) -> FloatArray:
        """Cost to go after each candidate plus a penalty for low clearance."""
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
        """Rise to see the path from above."""
        self.phase, self._waiting_s = Phase.RISING, math.nan
        self._looks_again = self._looked.is_near(state.p_w[:2], _ELSEWHERE_M)
        self._looked = Places(state.views, state.p_w[:2])
        self._tries_narrow &= not self._is_narrow(state)

    def _start_over(self, state: DroneState) -> None:
        """Reset the obstacles and look around, once per place: they may stem from a wrong depth or an old pose.

        Reset cells are freed by two views instead of up to ten, so they are not passed at hull distance.
        """
        if self._doubted.is_near(state.p_w[:2], _ELSEWHERE_M) or not state.tracked:
            self.phase = Phase.STUCK
            return
        self.space.doubt_solids()
        self._plan, self._least, self._progress_s = None, math.inf, state.stamp_s
        self._doubted, self._looked = Places(state.views, state.p_w[:2]), Places()
        self._rise(state)
        self._tries_narrow = True

    def _look(self, state: DroneState, error: float, turn: float) -> VelocityCommand:
        """Turn towards the path; rise if that opens nothing."""
        if abs(error) > math.radians(8.0):
            self._waiting_s = math.nan
            return VelocityCommand(turn_left_rad_s=turn, why="look along the path")
        if math.isnan(self._waiting_s):
            self._waiting_s = state.stamp_s
        elif state.stamp_s - self._waiting_s > _PATIENCE_S and state.tracked:  # no views come while tracking is lost
            self._rise(state)
        return VelocityCommand(turn_left_rad_s=turn, why="wait for a view of the path")
