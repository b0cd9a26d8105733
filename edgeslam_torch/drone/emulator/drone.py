"""The emulated drone's body: position, motion under commands, sensors."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from edgeslam_torch.drone.emulator.air import DRAG_PER_S, Air, ground_effect
from edgeslam_torch.drone.sdk_state import GRAVITY_M_S2
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, wrapped
from edgeslam_torch.types import FloatArray

STEP_S = 0.01
"""Of the simulation."""
SILENCE_LAND_S = 15.0
"""A Tello lands by itself after this time without a command."""
_HOVER_M = 0.8
_GROUND_M = 0.1
"""Height of camera and range sensor when the drone stands on the floor."""
_TAU_S = 0.35
"""Time constant of the velocity controller."""
RADIUS_M = 0.1
"""Of the sphere that holds body and propellers without guards: 18 cm from tip to tip across."""
_CRASH_M_S = 0.6
"""Slower, a Tello bounces off and flies on; faster, a propeller stops and it falls."""
_BOUNCE = 0.3
"""Share of the speed that is left after a bounce."""
_LEAN_S = 0.12
"""Time constant of the attitude controller."""
_MAX_LEAN_M_S2 = 4.0
"""Acceleration at the greatest lean, 22 degrees."""
_TURN_RAD_S = math.radians(90.0)
_SETTLED_S, _SETTLED_M = 1.0, 0.02
"""A landing drone that has not come this much lower for so long stands on something, and stops its motors."""


class Mode(StrEnum):
    """What the drone is doing."""

    GROUND = "on the ground"
    TAKEOFF = "taking off"
    FLYING = "flying"
    LANDING = "landing"


@dataclass(frozen=True, slots=True)
class Contact:
    """A touch of something that is not the floor."""

    clock_s: float
    p_w: FloatArray
    """``(3,)`` centre of the drone [m]."""
    speed_m_s: float
    crashed: bool
    """Whether the motors stopped; otherwise it bounced off."""
    doing: "Mode"


@dataclass(slots=True)
class DroneModel:
    """A sphere with first-order velocity control by an attitude that follows late, in moving air.

    World axes: x forward and y left at power-on, z up, origin on the floor below the power-on place.
    """

    clearance: Callable[[FloatArray], float] = lambda p: math.inf
    """Distance [m] of a point of the drone's world ``(3,)`` to the nearest surface other than the floor, now."""
    air: Air = field(default_factory=Air)
    battery: float = 1.0
    battery_per_s: float = 1.0 / 780.0
    """13 minutes of flight on a full battery."""
    p_w: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, _GROUND_M]))
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    acceleration: FloatArray = field(default_factory=lambda: np.zeros(3))
    yaw: float = 0.0
    yaw_rate: float = 0.0
    mode: Mode = Mode.GROUND
    clock_s: float = 0.0
    """Time since power-on [s]."""
    motor_s: float = 0.0
    """Time with motors on [s]."""
    rc: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Sticks in [-1, 1]: right, forward, up, clockwise."""
    contacts: list[Contact] = field(default_factory=list)
    lean_m_s2: FloatArray = field(default_factory=lambda: np.zeros(2))
    """Level acceleration that the present attitude gives, in the world ``(2,)``: gravity times the lean's tangent."""
    _target: FloatArray | None = None
    _target_yaw: float | None = None
    _speed: float = 0.5
    _busy_since: float = -1.0
    _lowest: tuple[float, float] = (math.inf, 0.0)
    """Height of the present landing [m], and when it was reached."""
    _clear_m: float = math.inf
    """Distance to the nearest surface at the end of the last step; infinite on the ground."""

    @property
    def flying(self) -> bool:
        """Whether it is off the ground."""
        return self.mode is not Mode.GROUND

    @property
    def busy(self) -> bool:
        """Whether a movement is still under way."""
        return self.mode in (Mode.TAKEOFF, Mode.LANDING) or self._target is not None or self._target_yaw is not None

    def take_off(self) -> bool:
        """Climb to 0.8 m; False when already flying or the battery is empty."""
        if self.flying or self.battery < 0.1:
            return False
        self.mode = Mode.TAKEOFF
        self._target = np.array([self.p_w[0], self.p_w[1], _GROUND_M + _HOVER_M])
        self._speed, self._busy_since = 0.5, self.clock_s
        return True

    def land(self) -> None:
        """Descend to the floor and stop."""
        if self.flying:
            self.stop()
            if self.mode is not Mode.LANDING:
                self._lowest = float(self.p_w[2]), self.clock_s
            self.mode = Mode.LANDING

    def cut(self) -> None:
        """Emergency: motors off; it drops."""
        self.stop()
        self.mode, self.velocity, self.yaw_rate = Mode.GROUND, np.zeros(3), 0.0
        self.lean_m_s2 = np.zeros(2)
        self.p_w = np.array([self.p_w[0], self.p_w[1], _GROUND_M])

    def stop(self) -> None:
        """Hover here."""
        self._target, self._target_yaw, self.rc = None, None, (0.0, 0.0, 0.0, 0.0)

    def move(self, body_m: FloatArray, speed_m_s: float = 0.5) -> None:
        """Fly by ``body_m`` ``(3,)`` forward, left, up, relative to the current heading."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        step = np.array([c * body_m[0] - s * body_m[1], s * body_m[0] + c * body_m[1], body_m[2]])
        self._target, self._speed, self._busy_since = self.p_w + step, speed_m_s, self.clock_s

    def turn(self, left_rad: float) -> None:
        """Turn by an angle, counter-clockwise positive; more than half a turn is flown in full."""
        self._target_yaw, self._busy_since = self.yaw + left_rad, self.clock_s

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        self.clock_s += dt
        if not self.flying:
            self._clear_m = math.inf
            return
        self.motor_s += dt
        self.battery = max(0.0, self.battery - dt * self.battery_per_s)
        if self.battery <= 0.05:
            self.land()
        self._step_velocity(dt)
        ahead = self.p_w + dt * self.velocity
        clear_m = self.clearance(ahead)
        if clear_m < min(RADIUS_M, self._clear_m):
            ahead = self._touch((self._clear_m - clear_m) / dt)
            clear_m = self.clearance(self.p_w)
        self.p_w, self._clear_m = ahead, clear_m
        self._step_yaw(dt)
        self._finish()

    def _step_velocity(self, dt: float) -> None:
        """Tilt towards the commanded velocity. The controller compensates drag, not wind."""
        wanted = (self._wanted_velocity() - self.velocity) / _TAU_S
        wanted = np.clip(wanted + DRAG_PER_S * self.velocity, -_MAX_LEAN_M_S2, _MAX_LEAN_M_S2)
        self.lean_m_s2 = self.lean_m_s2 + (1.0 - math.exp(-dt / _LEAN_S)) * (wanted[:2] - self.lean_m_s2)
        thrust = np.array([*self.lean_m_s2, wanted[2]])
        disturbed = self.air.drag(self.velocity, dt) + self.air.wash(self._clear_m)
        disturbed[2] += ground_effect(self.p_w[2]) - ground_effect(_HOVER_M)
        self.acceleration = thrust + disturbed
        self.velocity = self.velocity + dt * self.acceleration

    def _touch(self, closing_m_s: float) -> FloatArray:
        """Bounce off, or crash; returns where it is afterwards. What it touches may be what moves."""
        speed = max(float(np.linalg.norm(self.velocity)), closing_m_s if math.isfinite(closing_m_s) else 0.0)
        crashed = speed > _CRASH_M_S
        self.contacts.append(Contact(self.clock_s, self.p_w.copy(), speed, crashed, self.mode))
        if crashed:
            self.cut()
            return self.p_w
        self.velocity = -_BOUNCE * self.velocity
        self._target = None if self.mode is Mode.FLYING else self._target
        return self.p_w

    def _wanted_velocity(self) -> FloatArray:
        if self.mode is Mode.LANDING:
            return np.array([0.0, 0.0, -0.4])
        if self._target is not None:
            error = self._target - self.p_w
            distance = float(np.linalg.norm(error))
            return error * (min(self._speed, 1.5 * distance + 0.02) / max(distance, 1e-9))
        right, forward, up, _ = self.rc
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([c * forward + s * right, s * forward - c * right, up])

    def _step_yaw(self, dt: float) -> None:
        if self._target_yaw is not None:
            error = self._target_yaw - self.yaw
            wanted = math.copysign(min(_TURN_RAD_S, 3.0 * abs(error) + 0.05), error)
        else:
            wanted = -self.rc[3] * math.radians(100.0)
        self.yaw_rate += dt / 0.15 * (wanted - self.yaw_rate) if dt < 0.15 else wanted - self.yaw_rate
        self.yaw += dt * self.yaw_rate

    def _finish(self) -> None:
        late = self.clock_s - self._busy_since > 20.0  # pressed against a wall
        if self._target is not None and (late or float(np.linalg.norm(self._target - self.p_w)) < 0.04):
            self._target = None
            self.mode = Mode.FLYING
        if self._target_yaw is not None and (late or abs(self._target_yaw - self.yaw) < math.radians(1.0)):
            self._target_yaw = None
        if self.p_w[2] <= _GROUND_M:
            self.p_w = np.array([self.p_w[0], self.p_w[1], _GROUND_M])
            if self.mode is Mode.LANDING:
                self._stand()
            self.velocity = np.maximum(self.velocity, [-np.inf, -np.inf, 0.0])
        elif self.mode is Mode.LANDING and self._settles():
            self._stand()

    def _settles(self) -> bool:
        """Whether a landing goes no lower: on furniture."""
        height_m, at_s = self._lowest
        if self.p_w[2] < height_m - _SETTLED_M:
            self._lowest = float(self.p_w[2]), self.clock_s
        touches = bool(self.contacts) and self.clock_s - self.contacts[-1].clock_s < 0.5 * _SETTLED_S
        return touches and self.clock_s - at_s > _SETTLED_S  # else it only has to stop climbing first

    def _stand(self) -> None:
        self.mode, self.velocity, self.yaw_rate = Mode.GROUND, np.zeros(3), 0.0

    def rpy(self) -> FloatArray:
        """Roll, pitch, yaw [rad]: a multicopter leans the way it accelerates."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        ahead = c * self.lean_m_s2[0] + s * self.lean_m_s2[1] if self.flying else 0.0
        left = -s * self.lean_m_s2[0] + c * self.lean_m_s2[1] if self.flying else 0.0
        return np.array(
            [-math.atan(left / GRAVITY_M_S2), math.atan(ahead / GRAVITY_M_S2), float(wrapped(np.array(self.yaw)))]
        )

    def T_w_b(self) -> FloatArray:
        """Body to the drone's world, ``(4, 4)``."""
        T = np.eye(4)
        T[:3, :3] = matrix_from_rpy(self.rpy())
        T[:3, 3] = self.p_w
        return T

    def specific_force(self) -> FloatArray:
        """Specific force in body axes [m/s^2]."""
        force = np.array([0.0, 0.0, GRAVITY_M_S2]) + (self.acceleration if self.flying else 0.0)
        return se3.inverse(self.T_w_b())[:3, :3] @ force


def state_line(drone: DroneModel, mission_pads: bool = True) -> str:
    """State message in the SDK's format, units and axes.

    Velocities are truncated to whole decimetres per second, as the recorded flights show.
    """
    rpy = np.degrees(drone.rpy())
    v = np.trunc(10.0 * drone.velocity * [1.0, -1.0, -1.0] + 0.0).astype(int)
    force = 1e3 / GRAVITY_M_S2 * drone.specific_force() * [1.0, -1.0, -1.0]
    height = max(0.0, drone.p_w[2] - _GROUND_M)
    pads = "mid:-1;x:0;y:0;z:0;mpry:0,0,0;" if mission_pads else ""
    return (
        f"{pads}pitch:{round(-rpy[1])};roll:{round(rpy[0])};yaw:{round(-rpy[2])};"
        f"vgx:{v[0]};vgy:{v[1]};vgz:{v[2]};templ:58;temph:60;"
        f"tof:{max(10, round(100 * drone.p_w[2]))};h:{10 * round(10 * height)};bat:{math.ceil(100 * drone.battery)};"
        f"baro:{100.0 + height:.2f};time:{int(drone.motor_s)};"
        f"agx:{force[0]:.2f};agy:{force[1]:.2f};agz:{force[2]:.2f};\r\n"
    )
