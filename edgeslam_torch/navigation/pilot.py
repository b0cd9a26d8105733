"""Planner: computes velocity commands towards a skill's goals through known free space."""

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.arcs import Arcs, candidates
from edgeslam_torch.navigation.contact import Losses
from edgeslam_torch.navigation.drone_state import HOVER, Contact, DroneState, VelocityCommand, View
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.navigation.openings.exit_tracker import PLACES_M, ExitTracker
from edgeslam_torch.navigation.openings.wall_frame import Walls
from edgeslam_torch.navigation.route import TIGHT_M, CostToGo, cost_to_go
from edgeslam_torch.navigation.skills.skill import ROUND_S, Result, Skill
from edgeslam_torch.navigation.space import CELL_M, Space
from edgeslam_torch.navigation.speed_dither import dithered
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.navigation.views import ViewPlanner
from edgeslam_torch.types import FloatArray

BAND_M = 0.05
"""Required free height above and below the hull."""
TAKE_OFF_M = 0.5
"""Radius around the take-off that the operator keeps clear."""
_REPLAN_S = 0.5
_AHEAD_M = 0.8
"""Look-ahead distance along the path."""
_FACING_RAD = math.radians(30.0)
"""Heading error beyond which the drone turns first: it flies only where the camera looks."""
_SIDEWAYS, _SLOW = 0.3, 0.6
"""Shares of the speed: outside the field of view, through space observed before; and beside unknown cells at hull
distance, or back along the path."""
_STANDS_M_S = 0.1
"""Speed below which unknown cells of the next metre are viewed first: from closer they are out of the picture."""
_GAIN_M = 0.04
"""Minimum reduction of the cost to go by a movement [m]."""
_MOVES_S = 1.0
"""Maximum wait for a view after a scale revision; views come at 5 Hz."""
_UPRIGHT_M, _UPRIGHT_SHARE = (0.7, 1.5), 0.7
"""Heights visible on a wall two metres away, and the occupied share that makes a column a wall."""


class Phase(StrEnum):
    """State of the planner."""

    FLYING = "flying"
    DONE = "done"
    STUCK = "no way"


@dataclass(slots=True)
class Pilot:
    """Executes one skill at a time; a new one may be set at any time."""

    skill: Skill
    limits: NavLimits = field(default_factory=NavLimits)
    space: Space = field(default_factory=Space)
    result: Result | None = None
    """How the skill ended; None while it runs."""
    layer: Layer | None = None
    """The last layer, for viewers."""
    way_w: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """The last path, for viewers."""
    exits: ExitTracker = field(default_factory=ExitTracker)
    """Exits found so far, whatever the skill."""
    _plan: CostToGo | None = None
    _planned_s: float = -math.inf
    _progress: Places = field(default_factory=Places)
    """Position at the last progress."""
    _progress_s: float = -math.inf
    _started_over: bool = False
    """Whether it has started over there."""
    _revision: int = 0
    _revised_s: float = -math.inf
    """Last time at which the planner's scale was that of the states."""
    _at_take_off: bool = True
    """Whether the space around the take-off is not yet marked as free."""
    _view: View | None = None
    """The last view, for the camera's field of view."""
    _views: ViewPlanner = field(init=False)
    _losses: Losses = field(default_factory=Losses)
    """Tracking losses since the skill began."""
    _submap: int = 0
    """Current submap."""
    _submap_s: float = -math.inf
    """Capture time of its first frame; minus infinity once older views have been dropped."""

    def __post_init__(self) -> None:
        self._views = ViewPlanner(self.limits.radius_m + BAND_M, self.limits)

    def begin(self, skill: Skill) -> None:
        """Switch to another skill."""
        self.skill, self.result = skill, None
        self._plan, self._progress, self._views.look = None, Places(), None
        self._losses = Losses()

    @property
    def phase(self) -> Phase:
        """State of the planner."""
        if self.result is None:
            return Phase.FLYING
        return Phase.DONE if self.result.reached else Phase.STUCK

    @property
    def views(self) -> MapViews:
        """Views of the map, to which positions are tied."""
        return self.space.map_views

    def walls(self) -> Walls:
        """Layer at the flight height, and which of its occupied cells are upright."""
        layer = self.space.layer(self.limits.height_m, self.limits.radius_m + BAND_M)
        return Walls(layer, self.space.upright(*_UPRIGHT_M, _UPRIGHT_SHARE))

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
        self._losses.note(state)
        if self.result is None and self._views.look is None:
            self.result = self.skill.result(state, self._losses.count)
        return self._at_height(state, HOVER if self.result is not None else self._fly(state))

    def _take_in(self, state: DroneState) -> None:
        corrected = state.map_update is not None
        if state.map_update is not None:
            self.space.correct(state.map_update)
            self.exits.expire()
            self._plan = None
        elif state.revision != self._revision:
            self._forget()
        self._revision, self._revised_s = state.revision, state.stamp_s
        self._check_submap(state)
        # Metres of the clear area, known before those of the map: a correction of the scale has changed them with it.
        over_take_off = float(np.linalg.norm(state.p_w[:2])) < TAKE_OFF_M
        if self._at_take_off or (corrected and over_take_off):
            self._at_take_off = False
            for z in np.arange(0.1, self.limits.height_m + TAKE_OFF_M, 0.2):
                self.space.flown(np.array([*state.p_w[:2], z]), TAKE_OFF_M)
        self.space.follow(state.p_w)
        if state.view is not None:
            self._view = state.view
            self.space.observe(state.view)
        self.space.flown(state.p_w, self.limits.radius_m + BAND_M)
        if self.exits.due(state):
            self.exits.look(self.walls(), state)
            self._views.openings = self.exits.candidates
            self.skill.consider(self.exits.exits)
        elif corrected:  # what it was given lies where the map was
            self._views.openings = ()
            self.skill.consider(())

    def _check_submap(self, state: DroneState) -> None:
        """Drop views of other submaps if their position relative to this one is too uncertain."""
        if state.submap != self._submap:
            self._submap, self._submap_s = state.submap, state.stamp_s - state.blind_s
        if state.submap_sigma_m > DEAD_RECKONING_SIGMA_M and self._submap_s > -math.inf:
            self.space.forget_before(self._submap_s)
            self._views.start_over()
            self._plan, self._submap_s = None, -math.inf

    def _forget(self) -> None:
        """Reset: the relation of the old scale to the new one is unknown."""
        self.space, self.exits = Space(map_views=self.views), ExitTracker()
        self._plan, self._progress = None, Places()
        self._at_take_off, self._views = True, ViewPlanner(self._views.half_m, self.limits)

    def _turn(self, error_rad: float) -> float:
        return float(np.clip(2.0 * error_rad, -self.limits.turn_rad_s, self.limits.turn_rad_s))

    def _climb(self, error_m: float) -> float:
        return float(np.clip(1.5 * error_m, -self.limits.climb_m_s, self.limits.climb_m_s))

    def _at_height(self, state: DroneState, command: VelocityCommand) -> VelocityCommand:
        """The command at the flight height or that of a look; off the flight height the drone does not move on."""
        # Dead reckoning by truncated velocities drifts in height; the drone measures its height.
        dead_reckoning = not state.tracked and math.isfinite(state.reported_height_m)
        below_m = self.limits.height_m - (state.reported_height_m if dead_reckoning else float(state.p_w[2]))
        up = self._climb(below_m + (self._views.look.rise_m if self._views.look is not None else 0.0))
        moves = float(abs(below_m) < 2.0 * BAND_M)
        forward, left = moves * command.forward_m_s, moves * command.left_m_s
        return VelocityCommand(forward, left, up, command.turn_left_rad_s, command.why)

    def _fly(self, state: DroneState) -> VelocityCommand:
        here, stands = state.p_w[:2], float(np.linalg.norm(state.velocity_w[:2])) < _STANDS_M_S
        looks = self._views.taking(state) is not None or self.skill.looks(state, self._views)
        looks = looks or (stands and state.tracked and self._views.look_first(state))
        if not self._progress.is_near(here, PLACES_M):
            self._progress, self._progress_s, self._started_over = Places(state.views, here), state.stamp_s, False
        if looks or state.overridden:
            self._progress_s = state.stamp_s
        if looks:
            look = self._views.look
            turn = 0.0 if look is None else self._turn(state.turn_to_rad(look.heading_rad))
            return VelocityCommand(turn_left_rad_s=turn, why="look")
        if state.stamp_s - self._progress_s > ROUND_S:
            self._start_over(state)
            return HOVER
        plan = self._planned(state)
        if not math.isfinite(plan.at(here)):
            return VelocityCommand(turn_left_rad_s=0.5 * self.limits.turn_rad_s, why="no path: look around")
        self.way_w = plan.way(here, 3.0)
        ahead, faced = self._bearing(here), self.skill.faces_rad(state)
        error = state.turn_to_rad(ahead if faced is None else faced)
        turn = self._turn(error)
        chosen = self._chosen(state, plan, ahead, error)
        if (stands or chosen is None) and abs(error) < _FACING_RAD and state.tracked:
            unseen_w = self._unseen_w(state, self.way_w[: round(1.0 / CELL_M)])
            if self._views.look_along(unseen_w, ahead, self._view, state):
                chosen = None
        if chosen is None:
            return VelocityCommand(turn_left_rad_s=turn, why="wait for a view of the path")
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        return VelocityCommand(
            c * chosen[0] + s * chosen[1], c * chosen[1] - s * chosen[0], 0.0, turn, "along the path"
        )

    def _start_over(self, state: DroneState) -> None:
        """Observe obstacles anew, once per place: they may stem from a wrong depth or pose."""
        if self._started_over or not state.tracked:
            self.result = self.skill.no_way()
            return
        self.space.doubt_solids()
        self._views.start_over()
        self._plan, self._progress_s, self._started_over = None, state.stamp_s, True

    def _unseen_w(self, state: DroneState, way_w: FloatArray) -> FloatArray:
        """Unknown cells ``(U, 2)`` that block a path ``(W, 2)``."""
        assert self.layer is not None
        layer = self.layer
        need = self.limits.clearance_m(state.position_sigma_m) + CELL_M
        low, high = layer.cells(way_w.min(axis=0) - need), layer.cells(way_w.max(axis=0) + need) + 1
        part = np.s_[low[0] : high[0], low[1] : high[1]]
        p_w = layer.centres(low + np.argwhere(~layer.free[part] & ~layer.solid[part])).reshape(-1, 2)
        away = np.linalg.norm(p_w[:, None] - way_w, axis=-1).min(axis=1, initial=math.inf)
        return np.asarray(p_w[away < need])

    def _planned(self, state: DroneState) -> CostToGo:
        """The plan, updated every `_REPLAN_S`."""
        self.layer = self.space.layer(self.limits.height_m, self.limits.radius_m + BAND_M)
        if self._plan is None or state.stamp_s - self._planned_s >= _REPLAN_S:
            goals = self.skill.goals(self.layer, state, self._views)
            need, here = self.limits.clearance_m(state.position_sigma_m), self.layer.cells(state.p_w[:2])
            self._plan = cost_to_go(self.layer, goals, need, self._hull_m(state), here)
            self._planned_s = state.stamp_s
        return self._plan

    def _bearing(self, here: FloatArray) -> float:
        """Bearing of the path at `_AHEAD_M` ahead."""
        far = self.way_w[min(len(self.way_w) - 1, round(_AHEAD_M / CELL_M))] - here
        return math.atan2(far[1], far[0])

    def _chosen(self, state: DroneState, plan: CostToGo, ahead: float, error: float) -> FloatArray | None:
        """World velocity ``(2,)`` of the best candidate; None if hovering is as good."""
        assert self.layer is not None
        speed_m_s = dithered(self.limits.speed_m_s, state.stamp_s)
        here, blind = state.p_w[:2], not state.tracked
        arcs = candidates(self.layer, here, state.velocity_w[:2], ahead, self.limits, speed_m_s, blind)
        need = self.limits.clearance_m(state.position_sigma_m)
        standing = float(arcs.clearance_m[0])
        good = arcs.clearance_m >= need
        if standing < need:  # already too close: allow moves that increase the clearance
            good |= arcs.clearance_m >= standing - 1e-3
        good |= self._passes_slowly(arcs, state)
        score = self._score(arcs, plan, state, error)
        score[~good] = np.inf
        best = int(np.argmin(score))
        if best == 0 or not score[best] < score[0] - _GAIN_M:
            return None
        return arcs.velocity_w[best]

    def _passes_slowly(self, arcs: Arcs, state: DroneState) -> np.ndarray:
        """``(C,)`` slow moves with full clearance to obstacles but only hull distance to unknown cells, where no look
        shows more of them, and moves with hull distance to both along the path flown.

        Cells within 0.6 m beside the drone lie outside the vertical field of view, and a door frame that was passed was
        never seen from behind.
        """
        slow = arcs.share <= _SLOW
        hull_m = self._hull_m(state)
        beside = arcs.from_solid_m >= self.limits.clearance_m(state.position_sigma_m)
        # After a start over, unknown cells may be obstacles that were reset.
        beside &= self._views.exhausted.is_near(state.p_w[:2], PLACES_M) and not self._started_over
        back = (arcs.from_solid_m >= hull_m + 0.5 * CELL_M) & self.space.was_at(arcs.p_w).all(axis=1)
        return np.asarray(slow & (arcs.clearance_m >= hull_m) & (beside | back))

    def _hull_m(self, state: DroneState) -> float:
        """Hull radius plus two standard deviations of the position [m]."""
        return self.limits.radius_m + 2.0 * state.position_sigma_m

    def _score(self, arcs: Arcs, plan: CostToGo, state: DroneState, error: float) -> FloatArray:
        """Cost to go after each candidate plus a penalty for low clearance; infinite for fast ones outside the view."""
        away = arcs.from_solid_m if self._views.exhausted.is_near(state.p_w[:2], PLACES_M) else arcs.clearance_m
        score = np.asarray(plan.at(arcs.end_w)) + 0.5 * np.clip(TIGHT_M - away, 0.0, None)
        fast = arcs.share > _SIDEWAYS
        off = np.abs(wrapped(np.arctan2(arcs.velocity_w[:, 1], arcs.velocity_w[:, 0]) - state.yaw_rad))
        score[fast & ((off > _FACING_RAD) | (abs(error) > _FACING_RAD))] = np.inf
        return score
