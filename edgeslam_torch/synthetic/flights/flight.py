"""Seeded flights of a small drone, smooth to the fourth derivative.

A path (`paths`) is control points half a second apart. The flight is the quintic B-spline of them: it stays inside the
hull of six successive points (so it cuts corners a little and keeps clear of furniture) and is nowhere faster than they
are; roll and pitch follow its acceleration.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.noise import GRAVITY_M_S2
from edgeslam_torch.synthetic.flights.wind import blown
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

KNOT_S = 0.5
DEGREE = 5


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """Limits of a flight."""

    speed_m_s: float = 0.7
    """Cruising speed; never exceeded by more than the take-off's half metre a second."""
    yaw_rate_rad_s: float = np.deg2rad(35.0)
    hover_height_m: float = 1.15
    height_spread_m: float = 0.3
    clearance_m: float = 0.45
    """Kept from walls and furniture."""
    start_height_m: float = 0.4
    """Where the climb to the hover height starts, half a metre a second: just after lift-off. On the floor a Tello's
    camera is at 0.07 m."""
    glance_rad: float = np.deg2rad(25.0)
    """Maximum angle between heading and direction of flight."""
    view_m: float = 1.8
    """Minimum free view; the drone turns away from nearer surfaces."""
    wobble_m: float = 0.006
    wobble_rad: float = np.deg2rad(0.35)
    wind_m_s2: float = 0.0
    """Acceleration by a steady wind, against which the drone leans: 1 are 6 degrees."""
    gust_m_s2: float = 0.0
    """Standard deviation of that by gusts, on each level axis: .3 move a hovering drone by 8 cm."""
    camera_tilt_rad: float = np.deg2rad(12.0)
    """Camera's downward tilt; a Tello's is about 12 degrees."""

    def __post_init__(self) -> None:
        if not 0 < self.speed_m_s <= 2 or self.yaw_rate_rad_s <= 0:
            raise ValueError(f"speed must lie in (0, 2] m/s and the yaw rate be positive: {self}")


@dataclass(frozen=True, slots=True)
class Flight:
    """A flown trajectory, sampled."""

    stamps_s: FloatArray
    """``(F,)`` [s]."""
    T_w_b: FloatArray
    """``(F, 4, 4)`` body to world."""
    T_b_c: FloatArray
    """``(4, 4)`` camera to body."""
    velocity_w: FloatArray
    """``(F, 3)`` velocity of the body [m/s]."""

    @property
    def T_w_c(self) -> FloatArray:
        """``(F, 4, 4)`` camera to world."""
        return self.T_w_b @ self.T_b_c

    def twist_c(self, index: int) -> FloatArray:
        """Velocity and rotation rate of the camera in its own axes, ``(6,)``, by differences of the poses."""
        i, j = max(index - 1, 0), min(index + 1, len(self.stamps_s) - 1)
        dt = float(self.stamps_s[j] - self.stamps_s[i])
        T = self.T_w_c
        return se3.log(se3.inverse(T[i]) @ T[j]) / dt if dt > 0 else np.zeros(6)


Path = Callable[[np.random.Generator, World, float, FlightPlan], FloatArray]
"""Control points ``(N, 4)`` (x, y, z, yaw), one every `KNOT_S`, through a world for so many seconds.

Raises ValueError if the world has no free place with the clearance asked for."""


def fly(
    rng: np.random.Generator,
    world: World,
    frames: int,
    path: Path,
    *,
    rate_hz: float = 30.0,
    plan: FlightPlan | None = None,
    begin_s: float = 0.0,
) -> Flight:
    """A flight of ``frames`` frames; its recording begins ``begin_s`` after the path, whose spline starts from rest.

    Raises:
        ValueError: If there is no frame, or the world has no free place with the clearance asked for.
    """
    if frames < 1 or rate_hz <= 0:
        raise ValueError(f"a flight needs at least one frame and a positive rate, got {frames} at {rate_hz} Hz")
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    control = path(rng, world, stamps[-1] + begin_s + 1.0, plan)
    padded = np.pad(control, ((DEGREE, DEGREE), (0, 0)), mode="edge")
    knots = (np.arange(len(padded) + DEGREE + 1) - DEGREE) * KNOT_S
    spline = BSpline(knots, padded, DEGREE)
    flown = stamps + begin_s
    state, velocity, acceleration = (spline(flown, nu=k) for k in range(3))
    # Sum of a few sines: the drone's jitter, smooth and zero at the start.
    fade = 1.0 - np.exp(-((flown / 1.5) ** 2))
    frequency, phase = rng.uniform(0.4, 2.2, (6, 4)), rng.uniform(0, 2 * np.pi, (6, 4))
    waves = np.sin(2 * np.pi * frequency * stamps[:, None, None] + phase).mean(2) * 2.0 * fade[:, None]  # (F, 6)
    if plan.wind_m_s2 or plan.gust_m_s2:
        moved, speed, leaning = blown(rng, stamps, plan.wind_m_s2, plan.gust_m_s2)
        state[:, :3] += moved
        velocity[:, :3] += speed
        acceleration[:, :3] += leaning
    wobble = plan.wobble_m * waves[:, :3]
    wobble_velocity = np.gradient(wobble, stamps, axis=0) if frames > 1 else 0.0 * wobble
    yaw = state[:, 3]
    c, s = np.cos(yaw), np.sin(yaw)
    forward = (c * acceleration[:, 0] + s * acceleration[:, 1]) / GRAVITY_M_S2
    left = (-s * acceleration[:, 0] + c * acceleration[:, 1]) / GRAVITY_M_S2
    rpy = np.stack([-np.arctan(left), np.arctan(forward), yaw], axis=1) + plan.wobble_rad * waves[:, 3:]
    T_w_b = np.tile(np.eye(4), (frames, 1, 1))
    T_w_b[:, :3, :3] = Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    T_w_b[:, :3, 3] = state[:, :3] + wobble
    return Flight(stamps, T_w_b, camera_on_body(plan.camera_tilt_rad), velocity[:, :3] + wobble_velocity)
