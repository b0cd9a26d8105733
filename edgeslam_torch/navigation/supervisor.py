"""Supervisor between planner and drone: handles a hanging planner, missing frames and an uncertain scale.

Every order to the drone comes from here. It does no planning; it decides when a command must not be followed.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from edgeslam_torch.navigation.contact import PUSHED_M_S, Push
from edgeslam_torch.navigation.drone_state import Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.navigation.speed_dither import dithered, measurable
from edgeslam_torch.types import FloatArray

STALE_S = 0.3
"""Age of a command beyond which the sticks are centred."""
BLIND_S = 0.7
"""Frame age beyond which commands are not followed; a Tello's frame is 0.3 to 0.5 s old when it arrives."""
BACK_S = 1.5
"""Duration of a danger after which the drone backs up along the path flown, which was free."""
LAND_S = 10.0
"""Duration of a danger after which the drone lands."""
UNSURE_LAND_S = 30.0
"""The same for an uncertain scale: time for seven vertical oscillations, which make the scale observable."""
_BACK_M, _BACK_M_S = 1.0, 0.25
"""Distance and mean speed of backing up; without frames only telemetry measures the distance."""
SCALE_SIGMA = 0.10
_KNOWN_S, _BEFORE_S = 1.2, 6.0
"""Time before the tracking loss whose heading is restored to relocalise (frames are up to half a second late); the
second value if the first fails."""
DEAD_RECKONING_SIGMA_M = 0.12
"""Position standard deviation [m] up to which the drone flies on by dead reckoning: two of them equal margin plus hull.
Enough for the metre of path along which a bare wall fills the view."""
_WIGGLE_S, _WIGGLE_M_S = 2.0, 0.25
"""Half period and speed of the vertical oscillation that makes the scale observable."""
_TRAIL_M, _TRAIL_LENGTH = 0.05, 400
"""Distance between points of the path flown, and how many are kept: 20 m."""
_ONE_WAY_M = 0.3
"""Tolerance between the paths out and back."""
_HEIGHT_CONFLICT_M, _HEIGHT_CONFLICT_S = 0.5, 1.0
"""Difference of map height and reported height, and its duration, that indicate a wrong pose. A scale error of 10 % at
the highest flight, a delay of 0.5 s in a climb of 0.4 m/s and the drone's resolution of 0.1 m explain 0.45 m."""


class Danger(StrEnum):
    """Why the planner's command is not followed, by severity."""

    NONE = ""
    DEAD_RECKONING = "dead reckoning by telemetry: tracking lost"
    """The command is followed all the same, as for `BATTERY_HOME`."""
    NO_COMMAND = "no command: the planner is late or hangs"
    FENCE = "at the fence"
    SCALE = "scale uncertain"
    BLIND = "no recent frame"
    LOST = "tracking lost"
    HEIGHT_CONFLICT = "map height and reported height contradict each other"
    CONTACT = "contact: commanded to move, but not moving"
    NOT_METRIC = "no metric scale"
    HOLD = "hover requested by the operator"
    BATTERY_HOME = "battery low: return home"
    BATTERY = "battery empty: land"


_UNSURE = (Danger.SCALE, Danger.NOT_METRIC)
_FOLLOWED = (Danger.NONE, Danger.DEAD_RECKONING, Danger.BATTERY_HOME)


@dataclass(frozen=True, slots=True)
class Order:
    """Order to the drone."""

    command: VelocityCommand
    land: bool = False
    home: bool = False
    """Whether the planner should return home."""
    danger: Danger = Danger.NONE
    contact: Contact | None = None
    """Contact that the planner should add to its map."""

    @property
    def follows(self) -> bool:
        """Whether the planner's command is passed on."""
        return self.danger in _FOLLOWED


@dataclass(slots=True)
class Supervisor:
    """Checks states and commands; call `order` at least every 0.1 s, from a thread of its own."""

    limits: NavLimits = field(default_factory=NavLimits)
    views: MapViews = field(default_factory=MapViews)
    """The planner's views of the map."""
    landing: str = ""
    """Why it lands, if it does; a landing is never aborted."""
    hold: bool = False
    """Whether the operator requested hovering."""
    _state: DroneState | None = None
    _command: VelocityCommand | None = None
    _command_s: float = -math.inf
    _since_s: float = math.nan
    """Start of the current danger."""
    _severe_s: float = math.nan
    """Start of a danger other than an uncertain scale."""
    _onward: Push = field(default_factory=Push)
    """Contact detection along the planner's commands."""
    _backward: Push = field(default_factory=Push)
    """Contact detection while backing up."""
    _height_conflict_s: float = math.nan
    """Since when map height and reported height differ."""
    _sent: bool = True
    """Whether the last order passed the command on, or would have without contact."""
    _trail: Places = field(default_factory=lambda: Places(size=3))
    """The last positions flown, `_TRAIL_M` apart."""
    _home_w: FloatArray | None = None
    _known: Places = field(default_factory=Places)
    """Last tracked position."""
    _back_s: float = math.nan
    """Duration of backing up."""
    _headings: deque[tuple[float, float]] = field(default_factory=deque)
    """Times and headings of tracked states of the last `_BEFORE_S`."""

    def see(self, state: DroneState) -> None:
        """Set the newest state."""
        self._state = state
        if state.tracked:
            self._known = Places(self.views, state.p_w[:2])
            self._headings.append((state.stamp_s, state.yaw_rad))
            while self._headings[0][0] < state.stamp_s - _BEFORE_S:
                self._headings.popleft()
        if self._home_w is None:
            self._home_w = state.p_w.copy()
        moved = not len(self._trail) or float(np.linalg.norm(state.p_w - self._trail.last_w)) > _TRAIL_M
        if moved and self._danger(state, state.stamp_s) is Danger.NONE:
            self._trail.add(self.views, state.p_w)
            self._trail.keep(slice(-_TRAIL_LENGTH, None))

    def propose(self, command: VelocityCommand, now_s: float) -> None:
        """Set the planner's newest command, valid for `STALE_S`."""
        self._command, self._command_s = command, now_s

    def order(self, now_s: float) -> Order:
        """Order for the drone now."""
        if self._state is None:
            return Order(VelocityCommand(why="no state yet"), danger=Danger.NO_COMMAND)
        danger = self._danger(self._state, now_s)
        self._sent = danger in (Danger.NONE, Danger.CONTACT) and not self.hold
        home = self._state.battery <= self.limits.home_battery
        if danger is Danger.BATTERY or self.landing:
            return self._land(danger)
        if self.hold:
            self._since_s = math.nan
            return Order(VelocityCommand(why=str(Danger.HOLD)), danger=Danger.HOLD)
        if danger is Danger.NONE:
            self._since_s = math.nan
            assert self._command is not None
            shown = danger if self._state.tracked else Danger.DEAD_RECKONING
            return Order(self._within_heights(self._command), home=home, danger=Danger.BATTERY_HOME if home else shown)
        trouble_s = self._trouble_s(danger, now_s)
        patience_s = UNSURE_LAND_S if danger in _UNSURE else LAND_S + self._back_s - _BACK_M / _BACK_M_S
        in_vain = trouble_s > patience_s or now_s - self._since_s > UNSURE_LAND_S
        if in_vain or (danger is Danger.CONTACT and trouble_s > BACK_S + self._back_s):
            return self._land(danger)
        began = danger is Danger.CONTACT and trouble_s == 0.0
        contact = Contact(self._state.p_w.copy(), self._pushed_w(self._command)) if began else None
        command = self._meanwhile(danger, trouble_s)
        if self._backs_in_vain(command, now_s):
            self._trail.keep(slice(0))
            contact = Contact(self._state.p_w.copy(), self._pushed_w(command))
            command = VelocityCommand(why=f"{danger}: hover")
        return Order(command, home=home, danger=danger, contact=contact)

    def _land(self, danger: Danger) -> Order:
        self.landing = self.landing or str(danger)
        return Order(VelocityCommand(why=self.landing), land=True, danger=danger)

    def _backs_in_vain(self, command: VelocityCommand, now_s: float) -> bool:
        """Whether an obstacle blocks the way back."""
        assert self._state is not None
        return self._backward.holds(self._state, self._push_w(command), now_s)

    def _trouble_s(self, danger: Danger, now_s: float) -> float:
        """Duration of a danger of this severity; waiting for the scale does not count for the others."""
        if math.isnan(self._since_s):
            self._since_s, self._severe_s = now_s, math.nan
        if danger in _UNSURE:
            self._severe_s = math.nan
            return now_s - self._since_s
        if math.isnan(self._severe_s):
            self._severe_s = now_s
            self._back_s = (_BACK_M + self._dead_reckoned_m()) / _BACK_M_S
        return now_s - self._severe_s

    def _dead_reckoned_m(self) -> float:
        """Distance from the last tracked position [m]."""
        if len(self._known) == 0 or self._state is None:
            return 0.0
        return float(np.linalg.norm(self._state.p_w[:2] - self._known.last_w))

    def _danger(self, state: DroneState, now_s: float) -> Danger:
        late = state.blind_s + max(0.0, now_s - state.stamp_s)
        checks = (
            (state.battery <= self.limits.land_battery, Danger.BATTERY),
            (not state.metric, Danger.NOT_METRIC),
            (self._in_contact(state, now_s), Danger.CONTACT),
            (not state.tracked and not self._is_dead_reckoning(state), Danger.LOST),
            (self._heights_conflict(state, now_s), Danger.HEIGHT_CONFLICT),
            (late > BLIND_S, Danger.BLIND),
            (state.scale_sigma > SCALE_SIGMA or state.conflict, Danger.SCALE),
            (self._leaves(state), Danger.FENCE),
            (self._command is None or now_s - self._command_s > STALE_S, Danger.NO_COMMAND),
        )
        return next((danger for holds, danger in checks if holds), Danger.NONE)

    def _is_dead_reckoning(self, state: DroneState) -> bool:
        """Whether it may continue by dead reckoning: in translation only, since a turn may not restore tracking."""
        flies = self._command is not None and math.hypot(self._command.forward_m_s, self._command.left_m_s) > 0.0
        return flies and state.position_sigma_m < DEAD_RECKONING_SIGMA_M

    def _in_contact(self, state: DroneState, now_s: float) -> bool:
        """Whether the drone does not follow the commands that were passed on."""
        return self._onward.holds(state, self._push_w(self._command) if self._sent else None, now_s)

    def _pushed_w(self, command: VelocityCommand | None) -> FloatArray:
        """World direction ``(2,)`` of a command."""
        assert self._state is not None and command is not None
        c, s = math.cos(self._state.yaw_rad), math.sin(self._state.yaw_rad)
        forward, left = command.forward_m_s, command.left_m_s
        return np.array([c * forward - s * left, s * forward + c * left]) / math.hypot(forward, left)

    def _push_w(self, command: VelocityCommand | None) -> FloatArray | None:
        """The same for commands faster than `PUSHED_M_S`, else None."""
        pushes = command is not None and math.hypot(command.forward_m_s, command.left_m_s) > PUSHED_M_S
        return self._pushed_w(command) if pushes else None

    def _heights_conflict(self, state: DroneState, now_s: float) -> bool:
        """Whether map height and reported height differ although the scale is certain: the pose is wrong."""
        off = abs(state.reported_height_m - float(state.p_w[2]))
        if _is_doubtful(state) or not off > _HEIGHT_CONFLICT_M:  # also if NaN
            self._height_conflict_s = math.nan
            return False
        if math.isnan(self._height_conflict_s):
            self._height_conflict_s = now_s
        return now_s - self._height_conflict_s > _HEIGHT_CONFLICT_S

    def _leaves(self, state: DroneState) -> bool:
        """Whether the command leads farther beyond the fence."""
        assert self._home_w is not None
        away = state.p_w[:2] - self._home_w[:2]
        if float(np.linalg.norm(away)) < self.limits.fence_m or self._command is None:
            return False
        if math.hypot(self._command.forward_m_s, self._command.left_m_s) == 0.0:
            return False
        return float(away @ self._pushed_w(self._command)) > 0

    def _within_heights(self, command: VelocityCommand) -> VelocityCommand:
        assert self._state is not None
        heights, up = _heights_m(self._state), command.up_m_s
        if max(heights) > self.limits.highest_m:
            up = min(up, 0.0)
        if min(heights) < self.limits.lowest_m:
            up = max(up, 0.0)
        return VelocityCommand(command.forward_m_s, command.left_m_s, up, command.turn_left_rad_s, command.why)

    def _meanwhile(self, danger: Danger, trouble_s: float) -> VelocityCommand:
        """Hover, then the recovery manoeuvre of the danger."""
        assert self._state is not None
        if danger in _UNSURE:
            rising = int(trouble_s / _WIGGLE_S) % 2 == 0
            command = VelocityCommand(up_m_s=_WIGGLE_M_S if rising else -_WIGGLE_M_S, why=f"{danger}: up and down")
            return self._within_heights(command)
        if danger is Danger.LOST and trouble_s <= BACK_S:
            return VelocityCommand(turn_left_rad_s=self._turn_back(_KNOWN_S), why=f"{danger}: turn back")
        backing = BACK_S < trouble_s < BACK_S + self._back_s
        if danger in (Danger.BLIND, Danger.LOST, Danger.CONTACT) and backing:  # needs a valid pose
            turn = self._turn_back(_BEFORE_S) if danger is Danger.LOST else 0.0
            return replace(self._back(danger, trouble_s), turn_left_rad_s=turn)
        if danger is Danger.LOST and trouble_s > BACK_S + self._back_s:
            return VelocityCommand(turn_left_rad_s=0.5 * self.limits.turn_rad_s, why=f"{danger}: look around")
        return VelocityCommand(why=f"{danger}: hover")

    def _turn_back(self, before_s: float) -> float:
        """Yaw rate [rad/s] towards the heading at this time before tracking was lost."""
        assert self._state is not None
        if not self._headings:
            return 0.0
        moment = self._headings[-1][0] - before_s
        yaw = next(h for at, h in self._headings if at >= moment)
        error = self._state.turn_to_rad(yaw)
        return float(np.clip(2.0 * error, -self.limits.turn_rad_s, self.limits.turn_rad_s))

    def _back(self, danger: Danger, trouble_s: float) -> VelocityCommand:
        """Velocity back along the path flown."""
        assert self._state is not None
        here = self._state.p_w[:2]
        away = np.linalg.norm(self._trail.p_w[:, :2] - here, axis=1)
        self._trail.keep(slice(_latest_approach(away) + 1))
        while len(self._trail) and away[len(self._trail) - 1] < 2 * _TRAIL_M:
            self._trail.keep(slice(len(self._trail) - 1))
        if len(self._trail) == 0:
            return VelocityCommand(why=f"{danger}: hover")
        step = self._trail.last_w[:2] - here
        speed_m_s = dithered(_BACK_M_S, trouble_s)
        v_w = measurable(step * (speed_m_s / float(np.linalg.norm(step))))
        c, s = math.cos(self._state.yaw_rad), math.sin(self._state.yaw_rad)
        return VelocityCommand(
            c * v_w[0] + s * v_w[1], c * v_w[1] - s * v_w[0], 0.0, 0.0, f"{danger}: back up along the path flown"
        )


def _latest_approach(away_m: FloatArray) -> int:
    """Index of the latest close approach of a path, by the distances ``(N,)`` of its points to a place.

    The path may pass the place on the way out and back; the latest pass counts.
    """
    if len(away_m) == 0:
        return 0
    padded = np.concatenate([[np.inf], away_m, [np.inf]])
    passes = (away_m <= padded[:-2]) & (away_m <= padded[2:]) & (away_m <= away_m.min() + _ONE_WAY_M)
    return int(np.flatnonzero(passes)[-1])


def _is_doubtful(state: DroneState) -> bool:
    """Whether the map's scale is uncertain."""
    return not state.metric or state.scale_sigma > SCALE_SIGMA or state.conflict


def _heights_m(state: DroneState) -> list[float]:
    """Reported height and map height above the floor [m], without doubtful ones; at least one."""
    reported, mapped = state.reported_height_m, float(state.p_w[2])
    if not math.isfinite(reported):
        return [mapped]
    return [reported] if _is_doubtful(state) else [reported, mapped]
