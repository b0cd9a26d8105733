"""What stands between a pilot and the sticks: it works when the pilot hangs, the picture stops, or metres are doubtful.

Every order to the drone comes from here. It knows nothing of routes; it knows when not to fly.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.contact.push import PUSHED_M_S, Push
from edgeslam_torch.navigation.drone_state import Contact, DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.speed_dither import STEP_M_S, told, varied
from edgeslam_torch.types import FloatArray

STALE_S = 0.3
"""Age of a wish beyond which the sticks are centred."""
BLIND_S = 0.7
"""Age of the picture beyond which nothing new is flown into; a Tello's is 0.3 to 0.5 s old when it arrives."""
BACK_S = 1.5
"""Time of trouble after which it backs up along the way it came, which was free."""
LAND_S = 10.0
"""Time of trouble after which it lands."""
UNSURE_LAND_S = 30.0
"""The same when metres are doubtful: seven times up and down where it has been, which is what tells them, of this map
or, where that tells none for eight seconds, of the next (`flying/perception/map_reset.py`)."""
_BACK_M, _BACK_M_S = 1.0, 0.25
"""Way back, and its mean speed: without a picture telemetry alone says how far it came."""
SCALE_SIGMA = 0.10
_KNOWN_S, _BEFORE_S = 1.2, 6.0
"""How long before its pose was lost it looked at what it knew well: pictures are up to half a second late. If that
shows nothing, the second."""
CARRIED_SIGMA_M = 0.12
"""Standard deviation of the position up to which it flies on by telemetry alone where the picture shows nothing: two of
them are the margin and the hull. A bare wall fills the picture for a metre of way; telemetry carries as far."""
_WIGGLE_S, _WIGGLE_M_S = 2.0, 0.25
"""Up and down, which tells height and telemetry the scale."""
_TRAIL_M = 0.05
_ONE_WAY_M = 0.3
"""How far the way back may lie beside the way out."""
_APART_M, _APART_S = 0.5, 1.0
"""Heights of map and drone that are so far apart for so long cannot both be true. Together sure metres of 10 % at the
highest flight, a video that is 0.5 s late in a climb of 0.4 m/s, and the drone's own decimetres explain 0.45 m."""


class Danger(StrEnum):
    """Why the pilot's wish is not followed, the gravest last."""

    NONE = ""
    CARRIED = "carried by telemetry past what shows nothing"
    """The pilot's wish is followed all the same, as when the battery calls it home."""
    NO_WISH = "no wish of the pilot: planner late or hung"
    FENCE = "at the fence"
    SCALE = "metres are not sure"
    BLIND = "no fresh picture"
    LOST = "the pose rests on no map"
    APART = "the map and the drone's own height contradict each other"
    HELD = "commanded and not moving: contact"
    NOT_METRIC = "no metres"
    HAND = "held by hand"
    BATTERY_HOME = "battery low: home"
    BATTERY = "battery empty: land"


_UNSURE = (Danger.SCALE, Danger.NOT_METRIC)
_FOLLOWED = (Danger.NONE, Danger.CARRIED, Danger.BATTERY_HOME)


@dataclass(frozen=True, slots=True)
class Order:
    """What the drone is told."""

    wish: VelocityCommand
    land: bool = False
    home: bool = False
    """Whether the pilot should fly home."""
    danger: Danger = Danger.NONE
    touch: Contact | None = None
    """What the pilot should know of since it was just felt."""

    @property
    def follows(self) -> bool:
        """Whether the pilot's wish is passed on."""
        return self.danger in _FOLLOWED


@dataclass(slots=True)
class Supervisor:
    """Watches sights and wishes; `order` is to be asked at least every 0.1 s, from a thread of its own."""

    limits: NavLimits = field(default_factory=NavLimits)
    landing: bool = False
    """Once it lands, it lands."""
    held: bool = False
    """Whether a person wants it to hover."""
    _sight: DroneState | None = None
    _wish: VelocityCommand | None = None
    _wished_s: float = -math.inf
    _since_s: float = math.nan
    """Since when it is in trouble."""
    _grave_s: float = math.nan
    """Since when in other trouble than doubtful metres."""
    _onward: Push = field(default_factory=Push)
    """Whether it comes on where the pilot wants to."""
    _backward: Push = field(default_factory=Push)
    """Whether it comes back the way it came."""
    _apart_s: float = math.nan
    """Since when the heights of map and drone are apart."""
    _told: bool = True
    """Whether the drone was told the pilot's wish at the last order, or would have been but for being held."""
    _trail: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=400))
    """Where it flew, 5 cm apart."""
    _home_w: FloatArray | None = None
    _known_w: FloatArray | None = None
    """Where its pose rested on a map last."""
    _back_s: float = math.nan
    """How long it backs up, if its trouble makes it."""
    _headings: deque[tuple[float, float]] = field(default_factory=deque)
    """Moments and headings of the last `_BEFORE_S` with a pose that rests on a map."""

    def see(self, sight: DroneState) -> None:
        """The newest sight."""
        self._sight = sight
        if sight.tracked:
            self._known_w = sight.p_w
            self._headings.append((sight.stamp_s, sight.yaw_rad))
            while self._headings[0][0] < sight.stamp_s - _BEFORE_S:
                self._headings.popleft()
        if self._home_w is None:
            self._home_w = sight.p_w.copy()
        moved = not self._trail or float(np.linalg.norm(sight.p_w - self._trail[-1])) > _TRAIL_M
        if moved and self._danger(sight, sight.stamp_s) is Danger.NONE:
            self._trail.append(sight.p_w.copy())

    def carry(self, moved: MapUpdate) -> None:
        """Take the way flown along with the map."""
        self._trail = deque(moved.points(np.array(self._trail).reshape(-1, 3)), maxlen=self._trail.maxlen)
        if self._known_w is not None:
            self._known_w = moved.points(self._known_w[None])[0]

    def propose(self, wish: VelocityCommand, now_s: float) -> None:
        """The pilot's newest wish; it counts for `STALE_S`."""
        self._wish, self._wished_s = wish, now_s

    def order(self, now_s: float) -> Order:
        """What the drone is told now."""
        if self._sight is None:
            return Order(VelocityCommand(why="no sight yet"), danger=Danger.NO_WISH)
        danger = self._danger(self._sight, now_s)
        self._told = danger in (Danger.NONE, Danger.HELD) and not self.held
        home = self._sight.battery <= self.limits.home_battery
        if danger is Danger.BATTERY or self.landing:
            self.landing = True
            return Order(VelocityCommand(why=str(danger)), land=True, danger=danger)
        if self.held:
            self._since_s = math.nan
            return Order(VelocityCommand(why=str(Danger.HAND)), danger=Danger.HAND)
        if danger is Danger.NONE:
            self._since_s = math.nan
            assert self._wish is not None
            said = danger if self._sight.tracked else Danger.CARRIED
            return Order(self._within_heights(self._wish), home=home, danger=Danger.BATTERY_HOME if home else said)
        trouble_s = self._trouble_s(danger, now_s)
        patience_s = UNSURE_LAND_S if danger in _UNSURE else LAND_S + self._back_s - _BACK_M / _BACK_M_S
        in_vain = trouble_s > patience_s or now_s - self._since_s > UNSURE_LAND_S
        if in_vain or (danger is Danger.HELD and trouble_s > BACK_S + self._back_s):
            self.landing = True
            return Order(VelocityCommand(why=str(danger)), land=True, danger=danger)
        felt = danger is Danger.HELD and trouble_s == 0.0
        touch = Contact(self._sight.p_w.copy(), self._pushed_w(self._wish)) if felt else None
        wish = self._meanwhile(danger, trouble_s)
        if self._backs_in_vain(wish, now_s):
            self._trail.clear()
            touch = Contact(self._sight.p_w.copy(), self._pushed_w(wish))
            wish = VelocityCommand(why=f"{danger}: hover")
        return Order(wish, home=home, danger=danger, touch=touch)

    def _backs_in_vain(self, wish: VelocityCommand, now_s: float) -> bool:
        """Whether something holds it on its way back, which the map has in another place."""
        assert self._sight is not None
        return self._backward.holds(self._sight, self._push_w(wish), now_s)

    def _trouble_s(self, danger: Danger, now_s: float) -> float:
        """How long it has been in trouble of this gravity: waiting for metres uses up no patience with the rest."""
        if math.isnan(self._since_s):
            self._since_s, self._grave_s = now_s, math.nan
        if danger in _UNSURE:
            self._grave_s = math.nan
            return now_s - self._since_s
        if math.isnan(self._grave_s):
            self._grave_s = now_s
            self._back_s = (_BACK_M + self._carried_m()) / _BACK_M_S
        return now_s - self._grave_s

    def _carried_m(self) -> float:
        """Way since its pose rested on a map."""
        if self._known_w is None or self._sight is None:
            return 0.0
        return float(np.linalg.norm(self._sight.p_w[:2] - self._known_w[:2]))

    def _danger(self, sight: DroneState, now_s: float) -> Danger:
        late = sight.blind_s + max(0.0, now_s - sight.stamp_s)
        checks = (
            (sight.battery <= self.limits.land_battery, Danger.BATTERY),
            (not sight.metric, Danger.NOT_METRIC),
            (self._is_held(sight, now_s), Danger.HELD),
            (not sight.tracked and not self._is_carried(sight), Danger.LOST),
            (self._is_apart(sight, now_s), Danger.APART),
            (late > BLIND_S, Danger.BLIND),
            (sight.scale_sigma > SCALE_SIGMA or sight.conflict, Danger.SCALE),
            (self._leaves(sight), Danger.FENCE),
            (self._wish is None or now_s - self._wished_s > STALE_S, Danger.NO_WISH),
        )
        return next((danger for holds, danger in checks if holds), Danger.NONE)

    def _is_carried(self, sight: DroneState) -> bool:
        """Whether it goes on by telemetry alone: on its way, not in a turn to what it may not know."""
        flies = self._wish is not None and math.hypot(self._wish.forward_m_s, self._wish.left_m_s) > 0.0
        return flies and sight.position_sigma_m < CARRIED_SIGMA_M

    def _is_held(self, sight: DroneState, now_s: float) -> bool:
        """Whether it was told to move for a while and did not; a wish that was not passed on moves nothing."""
        return self._onward.holds(sight, self._push_w(self._wish) if self._told else None, now_s)

    def _pushed_w(self, wish: VelocityCommand | None) -> FloatArray:
        """Direction ``(2,)`` of a wish in the world."""
        assert self._sight is not None and wish is not None
        c, s = math.cos(self._sight.yaw_rad), math.sin(self._sight.yaw_rad)
        forward, left = wish.forward_m_s, wish.left_m_s
        return np.array([c * forward - s * left, s * forward + c * left]) / math.hypot(forward, left)

    def _push_w(self, wish: VelocityCommand | None) -> FloatArray | None:
        """The same of a wish that is to move it; None where it need not."""
        pushes = wish is not None and math.hypot(wish.forward_m_s, wish.left_m_s) > PUSHED_M_S
        return self._pushed_w(wish) if pushes else None

    def _is_apart(self, sight: DroneState, now_s: float) -> bool:
        """Whether the pose goes its own way: a map that is sure of its metres, and another height than the drone's."""
        off = abs(sight.told_height_m - float(sight.p_w[2]))
        if _doubtful(sight) or not off > _APART_M:  # false too where the drone says nothing
            self._apart_s = math.nan
            return False
        if math.isnan(self._apart_s):
            self._apart_s = now_s
        return now_s - self._apart_s > _APART_S

    def _leaves(self, sight: DroneState) -> bool:
        """Whether it is beyond the fence and wants to go farther."""
        assert self._home_w is not None
        away = sight.p_w[:2] - self._home_w[:2]
        if float(np.linalg.norm(away)) < self.limits.fence_m or self._wish is None:
            return False
        if math.hypot(self._wish.forward_m_s, self._wish.left_m_s) == 0.0:
            return False
        return float(away @ self._pushed_w(self._wish)) > 0

    def _within_heights(self, wish: VelocityCommand) -> VelocityCommand:
        assert self._sight is not None
        heights, up = _heights_m(self._sight), wish.up_m_s
        if max(heights) > self.limits.highest_m:
            up = min(up, 0.0)
        if min(heights) < self.limits.lowest_m:
            up = max(up, 0.0)
        return VelocityCommand(wish.forward_m_s, wish.left_m_s, up, wish.turn_left_rad_s, wish.why)

    def _meanwhile(self, danger: Danger, trouble_s: float) -> VelocityCommand:
        """Hover; then what may mend it."""
        assert self._sight is not None
        if danger in _UNSURE:
            rising = int(trouble_s / _WIGGLE_S) % 2 == 0
            wish = VelocityCommand(up_m_s=_WIGGLE_M_S if rising else -_WIGGLE_M_S, why=f"{danger}: up and down")
            return self._within_heights(wish)
        if danger is Danger.LOST and trouble_s <= BACK_S:
            return VelocityCommand(turn_left_rad_s=self._turn_back(_KNOWN_S), why=f"{danger}: turn to what was known")
        backing = BACK_S < trouble_s < BACK_S + self._back_s
        if danger in (Danger.BLIND, Danger.LOST, Danger.HELD) and backing:  # not where the pose itself is wrong
            turn = self._turn_back(_BEFORE_S) if danger is Danger.LOST else 0.0
            return replace(self._back(danger, trouble_s), turn_left_rad_s=turn)
        if danger is Danger.LOST and trouble_s > BACK_S + self._back_s:
            return VelocityCommand(turn_left_rad_s=0.5 * self.limits.turn_rad_s, why=f"{danger}: look around")
        return VelocityCommand(why=f"{danger}: hover")

    def _turn_back(self, before_s: float) -> float:
        """Rate of the turn [rad/s] to where it looked this long before its pose was lost."""
        assert self._sight is not None
        if not self._headings:
            return 0.0
        moment = self._headings[-1][0] - before_s
        yaw = next(h for at, h in self._headings if at >= moment)
        error = float(wrapped(np.array(yaw - self._sight.yaw_rad)))
        return float(np.clip(2.0 * error, -self.limits.turn_rad_s, self.limits.turn_rad_s))

    def _back(self, danger: Danger, trouble_s: float) -> VelocityCommand:
        """Along the trail, away from where the trouble began."""
        assert self._sight is not None
        here = self._sight.p_w[:2]
        away = np.linalg.norm(np.array(self._trail).reshape(-1, 3)[:, :2] - here, axis=1)
        nearest = _latest_approach(away)
        while self._trail and (len(self._trail) - 1 > nearest or away[len(self._trail) - 1] < 2 * _TRAIL_M):
            self._trail.pop()
        if not self._trail:
            return VelocityCommand(why=f"{danger}: hover")
        step = self._trail[-1][:2] - here
        speed_m_s = varied(_BACK_M_S + 0.5 * STEP_M_S, trouble_s)
        v_w = told(step * (speed_m_s / float(np.linalg.norm(step))))
        c, s = math.cos(self._sight.yaw_rad), math.sin(self._sight.yaw_rad)
        return VelocityCommand(
            c * v_w[0] + s * v_w[1], c * v_w[1] - s * v_w[0], 0.0, 0.0, f"{danger}: back the way it came"
        )


def _latest_approach(away_m: FloatArray) -> int:
    """Where along a way, by the distances ``(N,)`` of its points, a place lies: on its latest pass, not on the way out
    when it is flown back."""
    if len(away_m) == 0:
        return 0
    padded = np.concatenate([[np.inf], away_m, [np.inf]])
    passes = (away_m <= padded[:-2]) & (away_m <= padded[2:]) & (away_m <= away_m.min() + _ONE_WAY_M)
    return int(np.flatnonzero(passes)[-1])


def _doubtful(sight: DroneState) -> bool:
    """Whether the map's metres are."""
    return not sight.metric or sight.scale_sigma > SCALE_SIGMA or sight.conflict


def _heights_m(sight: DroneState) -> list[float]:
    """Heights above the floor by the drone and by the map, as far as they are known and not doubtful; at least one."""
    told, mapped = sight.told_height_m, float(sight.p_w[2])
    if not math.isfinite(told):
        return [mapped]
    return [told] if _doubtful(sight) else [told, mapped]
