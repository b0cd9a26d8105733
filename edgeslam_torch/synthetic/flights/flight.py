"""Seeded flights of a small drone: take-off, then inspection of a world, smooth to the fourth derivative.

The path is a quintic B-spline whose control points, half a second apart, wander from one free place to the next.
It stays inside the hull of six successive control points (so it cuts corners a little and keeps clear of furniture)
and is nowhere faster than they are.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.wind import blown
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

GRAVITY_M_S2 = 9.81
KNOT_S = 0.5
DEGREE = 5
_HOVERED_S = 3.0
"""Time hovered before a recording that begins with a hover."""
_DRIFT_M = 0.02
"""Standard deviation of a hovering drone's drift in half a second, on each axis: 3 cm all in all."""
_AROUND_M = 0.8
"""Way before and after the corner of a rectangle within which the drone turns."""
_CORNER_SPEED = 0.6
"""Share of the speed around it: a turn of 90 degrees at 28 degrees a second."""
CORNER_M = 0.1
"""Maximum cut of the polyline's corners at nominal speeds; added to the clearance of its legs."""


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
    take_off: bool = True
    """Start low and climb to the hover height, half a metre a second."""
    start_height_m: float = 0.4
    """Where the climb starts: just after lift-off. On the floor a Tello's camera is at 0.07 m."""
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


def fly(
    rng: np.random.Generator,
    world: World,
    frames: int,
    *,
    rate_hz: float = 30.0,
    plan: FlightPlan | None = None,
) -> Flight:
    """A flight of ``frames`` frames through a world's free space.

    Raises:
        ValueError: If the world has no free place with the clearance asked for.
    """
    if frames < 1 or rate_hz <= 0:
        raise ValueError(f"a flight needs at least one frame and a positive rate, got {frames} at {rate_hz} Hz")
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    control = _control_points(rng, world, stamps[-1] + 1.0, plan)
    return _sampled(rng, control, stamps, plan)


def fly_after_hover(
    rng: np.random.Generator,
    world: World,
    frames: int,
    *,
    rate_hz: float = 30.0,
    plan: FlightPlan | None = None,
    turning: bool = False,
) -> Flight:
    """A flight whose first second is a hover, or a turn on the spot at the plan's yaw rate, and like `fly` afterwards.

    Raises:
        ValueError: If the world has no free place with the clearance asked for.
    """
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    here = _free_place(rng, world, plan)
    yaw = _open_direction(rng, world, here)
    # The recording begins in the middle of the hover: the spline itself starts from rest.
    still = round((_HOVERED_S + 1.0) / KNOT_S)
    step = plan.yaw_rate_rad_s * KNOT_S if turning else 0.0
    rows = [[*here, yaw - step * (still - 1 - k)] for k in range(still)]
    control = _cruise(rng, world, rows, stamps[-1] + _HOVERED_S + 1.0, plan)
    return _sampled(rng, control, stamps, plan, _HOVERED_S)


def climb(
    rng: np.random.Generator, world: World, frames: int, *, rate_hz: float = 30.0, plan: FlightPlan | None = None
) -> Flight:
    """Straight up and down at one place, half a metre a second, between the plan's start height and the ceiling."""
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    here = _free_place(rng, world, plan)
    yaw = _open_view(world, here, _open_direction(rng, world, here), plan.view_m)
    low = float(world.floor_below(here[None])[0]) + plan.start_height_m
    high = float(world.bounds_w[1, 2]) - plan.clearance_m
    steps = int((stamps[-1] + 1.0) / KNOT_S) + 1
    risen = 0.5 * KNOT_S * np.arange(steps) % (2.0 * (high - low))
    z = low + np.minimum(risen, 2.0 * (high - low) - risen)
    control = np.column_stack([np.tile(here[:2], (steps, 1)), z, np.full(steps, yaw)])
    return _sampled(rng, control, stamps, plan)


def fly_around(
    rng: np.random.Generator,
    world: World,
    frames: int,
    *,
    rate_hz: float = 30.0,
    plan: FlightPlan | None = None,
    sides_m: tuple[float, float] = (11.0, 9.0),
) -> Flight:
    """Along a rectangle around the origin, again and again, looking ahead; the second round begins as the first did.

    Args:
        rng: Of height, distance from the line, glances to the side and jitter.
        world: With free air along the rectangle.
        frames: Length of the flight.
        rate_hz: Frames a second.
        plan: Its speed is flown along the sides and `_CORNER_SPEED` of it around the corners.
        sides_m: Length and breadth of the rectangle.
    """
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    seconds = float(stamps[-1]) + 1.0
    start_m = 0.5 * sides_m[0] - 1.0
    low = world.bounds_w[0, 2]
    risen = np.arange(low + plan.start_height_m, low + plan.hover_height_m, 0.5 * KNOT_S)[
        : None if plan.take_off else 0
    ]
    way = [start_m] * (len(risen) + 1)
    while len(way) * KNOT_S < seconds:
        near = _to_corner(way[-1], sides_m) < _AROUND_M
        way.append(way[-1] + plan.speed_m_s * (_CORNER_SPEED if near else 1.0) * KNOT_S)
    x, y, heading = np.array([_on_rectangle(s, sides_m) for s in way]).T
    wander = _slow_waves(rng, len(way), 3) * np.minimum(1.0, np.maximum(0.0, np.array(way) - start_m))[:, None]
    aside, up, glance = (wander * [0.2, plan.height_spread_m, np.deg2rad(10.0)]).T
    z = np.full(len(way), low + plan.hover_height_m)
    z[: len(risen)] = risen
    control = [x - aside * np.sin(heading), y + aside * np.cos(heading), z + up, heading + glance]
    return _sampled(rng, np.column_stack(control), stamps, plan)


def _to_corner(way_m: float, sides_m: tuple[float, float]) -> float:
    """Distance along a rectangle from a place on it to its nearest corner."""
    length, breadth = sides_m
    corners = np.array([0.0, length, length + breadth, 2 * length + breadth, 2 * (length + breadth)])
    return float(np.abs(way_m % corners[-1] - corners).min())


def _on_rectangle(way_m: float, sides_m: tuple[float, float]) -> tuple[float, float, float]:
    """x, y and the heading, which goes on turning, so far along a rectangle around the origin, from its low corner."""
    length, breadth = sides_m
    corners = np.array([[-length, -breadth], [length, -breadth], [length, breadth], [-length, breadth]]) / 2
    left, side = way_m, 0
    while left > sides_m[side % 2]:
        left -= sides_m[side % 2]
        side += 1
    here, there = corners[side % 4], corners[(side + 1) % 4]
    x, y = here + left / sides_m[side % 2] * (there - here)
    # The turn of a corner is spread over the way before and after it.
    to_corner, from_corner = 1.0 - (sides_m[side % 2] - left) / _AROUND_M, 1.0 - left / _AROUND_M
    heading = side + 0.5 * np.clip(to_corner, 0.0, 1.0) - 0.5 * np.clip(from_corner, 0.0, 1.0)
    return float(x), float(y), float(heading) * np.pi / 2


def _slow_waves(rng: np.random.Generator, count: int, columns: int) -> FloatArray:
    """Smooth random curves within -1 and 1, ``(count, columns)``, one value every `KNOT_S`."""
    frequency, phase = rng.uniform(0.03, 0.12, (3, columns)), rng.uniform(0.0, 2.0 * np.pi, (3, columns))
    time_s = KNOT_S * np.arange(count)
    return np.sin(2.0 * np.pi * frequency * time_s[:, None, None] + phase).mean(axis=1)


def turn(
    rng: np.random.Generator, world: World, frames: int, *, rate_hz: float = 30.0, plan: FlightPlan | None = None
) -> Flight:
    """Round and round on the spot at the plan's yaw rate, drifting some centimetres as a hovering drone does."""
    plan = plan or FlightPlan()
    stamps = np.arange(frames) / rate_hz
    here = _free_place(rng, world, plan)
    steps = int((stamps[-1] + 1.0) / KNOT_S) + 1
    drift = np.zeros((steps, 3))
    for k in range(1, steps):
        drift[k] = 0.8 * drift[k - 1] + rng.normal(0.0, _DRIFT_M, 3)
    yaw = _open_direction(rng, world, here) + plan.yaw_rate_rad_s * KNOT_S * np.arange(steps)
    return _sampled(rng, np.column_stack([here + drift, yaw]), stamps, plan)


def _sampled(
    rng: np.random.Generator, control: FloatArray, stamps: FloatArray, plan: FlightPlan, begin_s: float = 0.0
) -> Flight:
    """Poses along the spline of control points ``(N, 4)`` (x, y, z, yaw); roll and pitch follow the acceleration.

    ``begin_s`` is the spline's time at the first stamp.
    """
    padded = np.vstack([np.repeat(control[:1], DEGREE, axis=0), control, np.repeat(control[-1:], DEGREE, axis=0)])
    knots = (np.arange(len(padded) + DEGREE + 1) - DEGREE) * KNOT_S
    spline = BSpline(knots, padded, DEGREE)
    # Sum of a few sines: the drone's jitter, smooth and zero at the start.
    flown = stamps + begin_s
    fade = 1.0 - np.exp(-((flown / 1.5) ** 2))
    state, velocity, acceleration = (spline(flown, nu=k) for k in range(3))
    frequency, phase = rng.uniform(0.4, 2.2, (6, 4)), rng.uniform(0, 2 * np.pi, (6, 4))
    waves = np.sin(2 * np.pi * frequency * stamps[:, None, None] + phase).mean(2) * 2.0 * fade[:, None]  # (F, 6)
    if plan.wind_m_s2 or plan.gust_m_s2:
        moved, speed, leaning = blown(rng, stamps, plan.wind_m_s2, plan.gust_m_s2)
        state[:, :3] += moved
        velocity[:, :3] += speed
        acceleration[:, :3] += leaning
    p_w = state[:, :3] + plan.wobble_m * waves[:, :3]
    wobble_velocity = np.gradient(plan.wobble_m * waves[:, :3], stamps, axis=0) if len(stamps) > 1 else 0.0 * p_w
    yaw = state[:, 3]
    c, s = np.cos(yaw), np.sin(yaw)
    forward = (c * acceleration[:, 0] + s * acceleration[:, 1]) / GRAVITY_M_S2
    left = (-s * acceleration[:, 0] + c * acceleration[:, 1]) / GRAVITY_M_S2
    roll, pitch = -np.arctan(left), np.arctan(forward)
    rpy = np.stack([roll, pitch, yaw], axis=1) + plan.wobble_rad * waves[:, 3:]
    T_w_b = np.tile(np.eye(4), (len(stamps), 1, 1))
    T_w_b[:, :3, :3] = Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix()
    T_w_b[:, :3, 3] = p_w
    return Flight(stamps, T_w_b, camera_on_body(plan.camera_tilt_rad), velocity[:, :3] + wobble_velocity)


def _control_points(rng: np.random.Generator, world: World, duration_s: float, plan: FlightPlan) -> FloatArray:
    """``(N, 4)`` x, y, z, yaw every `KNOT_S`, from the floor up and on from place to place."""
    here = _free_place(rng, world, plan)
    yaw = _open_direction(rng, world, here)
    rows = []
    if plan.take_off:
        floor = float(world.floor_below(here[None])[0]) + plan.start_height_m
        rows += [[here[0], here[1], z, yaw] for z in np.arange(floor, here[2], 0.5 * KNOT_S)]
    rows.append([*here, yaw])
    return _cruise(rng, world, rows, duration_s, plan)


def _cruise(
    rng: np.random.Generator, world: World, rows: list[list[float]], duration_s: float, plan: FlightPlan
) -> FloatArray:
    """Control points ``(N, 4)``: those given, and from the last of them on from place to place."""
    here, yaw = np.array(rows[-1][:3]), rows[-1][3]
    heading = yaw
    while len(rows) * KNOT_S < duration_s:
        there = _next_place(rng, world, here, heading, plan)
        heading = float(np.arctan2(there[1] - here[1], there[0] - here[0]))
        wanted = _open_view(world, there, heading + rng.uniform(-1, 1) * plan.glance_rad, plan.view_m)
        target = yaw + _wrapped(wanted - yaw)
        distance = float(np.linalg.norm(there - here))
        seconds = max(distance / (plan.speed_m_s * rng.uniform(0.7, 1.0)), abs(target - yaw) / plan.yaw_rate_rad_s)
        steps = max(1, int(np.ceil(seconds / KNOT_S)))
        share = np.arange(1, steps + 1)[:, None] / steps
        start, end = np.array([*here, yaw]), np.array([*there, target])
        rows += (start + share * (end - start)).tolist()
        here, yaw = there, target
    return np.array(rows)


def _open_view(world: World, p_w: FloatArray, yaw: float, view_m: float) -> float:
    """The direction nearest to ``yaw`` in which the next ``view_m`` metres are free; the freest if none is."""
    reach = np.linspace(0.4, view_m, 8)
    best, best_free = yaw, -1
    for turn in np.deg2rad([0, 25, -25, 50, -50, 75, -75, 105, -105, 140, -140, 180]):
        ray = p_w + reach[:, None] * np.array([np.cos(yaw + turn), np.sin(yaw + turn), 0.0])
        blocked = np.flatnonzero(world.clearance(ray) < 0.1)
        free = int(blocked[0]) if len(blocked) else len(reach)
        if free > best_free:
            best, best_free = yaw + float(turn), free
        if free == len(reach):
            break
    return best


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _free_place(rng: np.random.Generator, world: World, plan: FlightPlan) -> FloatArray:
    """The roomiest of some places at hover height with free air down to the floor."""
    low, high = world.bounds_w
    p = rng.uniform(low, high, (200, 3))
    p[:, 2] = min(low[2] + plan.hover_height_m, high[2] - plan.clearance_m)
    clear = world.clearance(p)
    clear[world.floor_below(p) > low[2] + 0.05] = -np.inf  # not above a table
    best = int(np.argmax(clear))
    if clear[best] < plan.clearance_m + CORNER_M:
        raise ValueError(f"{world.name}: no place with {plan.clearance_m} m of free air around it")
    roomy = np.flatnonzero(clear >= max(plan.clearance_m + CORNER_M, 0.75 * clear[best]))
    return p[int(rng.choice(roomy))]


def _open_direction(rng: np.random.Generator, world: World, p_w: FloatArray) -> float:
    """Among some headings, the one with the longest free flight."""
    yaws = rng.uniform(-np.pi, np.pi) + np.arange(12) * (np.pi / 6)
    reach = np.arange(0.3, 8.0, 0.3)
    best, best_free = 0.0, -1
    for yaw in yaws:
        ray = p_w + reach[:, None] * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        blocked = np.flatnonzero(world.clearance(ray) < 0.3)
        free = int(blocked[0]) if len(blocked) else len(reach)
        if free > best_free:
            best, best_free = float(yaw), free
    return best


def _next_place(
    rng: np.random.Generator, world: World, here: FloatArray, heading: float, plan: FlightPlan
) -> FloatArray:
    """A free place 0.5 to 2.5 m on, reached in a straight line, preferably ahead."""
    low, high = world.bounds_w
    best, best_score = here, -np.inf
    for _ in range(48):
        turn = rng.normal(0.0, 0.9) if rng.random() < 0.8 else rng.uniform(-np.pi, np.pi)
        distance = rng.uniform(0.5, 2.5)
        step = distance * np.array([np.cos(heading + turn), np.sin(heading + turn), 0.0])
        there = here + step
        there[2] = low[2] + plan.hover_height_m + rng.uniform(-1, 1) * plan.height_spread_m
        there[2] = min(there[2], high[2] - plan.clearance_m)
        line = here + np.linspace(0, 1, 12)[1:, None] * (there - here)
        clear = float(world.clearance(line).min())
        if clear < plan.clearance_m + CORNER_M:
            continue
        score = distance - 0.5 * abs(turn) + rng.uniform(0, 0.5)
        if score > best_score:
            best, best_score = there, score
        if best_score > 1.6:
            break
    if best_score == -np.inf:  # boxed in: rise or sink a little, the heading is drawn anew next time
        best = here.copy()
        best[2] = np.clip(here[2] + rng.uniform(-0.2, 0.2), low[2] + 0.6, high[2] - plan.clearance_m)
    return best
