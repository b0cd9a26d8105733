"""Paths of flights: take-off and inspection of a world, a hover or turn first, up and down, around a rectangle."""

import numpy as np

from edgeslam_torch.synthetic.flights.flight import KNOT_S, FlightPlan, Path
from edgeslam_torch.synthetic.flights.wind import correlated
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
HOVERED_S = 3.0
"""Time hovered before a recording that begins with a hover."""
_DRIFT_M = 0.02
"""Standard deviation of a hovering drone's drift in half a second, on each axis: 3 cm all in all."""
_AROUND_M = 0.8
"""Way before and after the corner of a rectangle within which the drone turns."""
_CORNER_SPEED = 0.6
"""Share of the speed around it: a turn of 90 degrees at 28 degrees a second."""
CORNER_M = 0.1
"""Maximum cut of the polyline's corners at nominal speeds; added to the clearance of its legs."""


def inspect(rng: Rng, world: World, seconds: float, plan: FlightPlan) -> FloatArray:
    """From the floor up and on from one free place to the next."""
    here = _free_place(rng, world, plan)
    yaw = _open_direction(rng, world, here)
    floor = float(world.floor_below(here[None])[0]) + plan.start_height_m
    rows = [[here[0], here[1], z, yaw] for z in np.arange(floor, here[2], 0.5 * KNOT_S)]
    return _cruise(rng, world, [*rows, [*here, yaw]], seconds, plan)


def hover_first(rng: Rng, world: World, seconds: float, plan: FlightPlan, turning: bool = False) -> FloatArray:
    """A hover of `HOVERED_S` and a second, or a turn on the spot at the plan's yaw rate; then like `inspect`."""
    here = _free_place(rng, world, plan)
    yaw = _open_direction(rng, world, here)
    still = round((HOVERED_S + 1.0) / KNOT_S)
    step = plan.yaw_rate_rad_s * KNOT_S if turning else 0.0
    rows = [[*here, yaw - step * (still - 1 - k)] for k in range(still)]
    return _cruise(rng, world, rows, seconds, plan)


def climb(rng: Rng, world: World, seconds: float, plan: FlightPlan) -> FloatArray:
    """Straight up and down at one place, half a metre a second, between the plan's start height and the ceiling."""
    here = _free_place(rng, world, plan)
    yaw = _open_view(world, here, _open_direction(rng, world, here), plan.view_m)
    low = float(world.floor_below(here[None])[0]) + plan.start_height_m
    high = float(world.bounds_w[1, 2]) - plan.clearance_m
    steps = int(seconds / KNOT_S) + 1
    risen = 0.5 * KNOT_S * np.arange(steps) % (2.0 * (high - low))
    z = low + np.minimum(risen, 2.0 * (high - low) - risen)
    return np.column_stack([np.tile(here[:2], (steps, 1)), z, np.full(steps, yaw)])


def turn(rng: Rng, world: World, seconds: float, plan: FlightPlan) -> FloatArray:
    """Round and round on the spot at the plan's yaw rate, drifting some centimetres as a hovering drone does."""
    here = _free_place(rng, world, plan)
    steps = int(seconds / KNOT_S) + 1
    drift = correlated(np.concatenate([np.zeros((1, 3)), rng.normal(0.0, _DRIFT_M, (steps - 1, 3))]), 0.8)
    yaw = _open_direction(rng, world, here) + plan.yaw_rate_rad_s * KNOT_S * np.arange(steps)
    return np.column_stack([here + drift, yaw])


def around(sides_m: tuple[float, float]) -> Path:
    """Along a rectangle around the origin, again and again, looking ahead; the second round begins as the first did.

    The plan's speed is flown along the sides and `_CORNER_SPEED` of it around the corners.
    """

    def path(rng: Rng, world: World, seconds: float, plan: FlightPlan) -> FloatArray:
        start_m = 0.5 * sides_m[0] - 1.0
        low = world.bounds_w[0, 2]
        risen = np.arange(low + plan.start_height_m, low + plan.hover_height_m, 0.5 * KNOT_S)
        way = [start_m] * (len(risen) + 1)
        while len(way) * KNOT_S < seconds:
            near = _to_corner(way[-1], sides_m) < _AROUND_M
            way.append(way[-1] + plan.speed_m_s * (_CORNER_SPEED if near else 1.0) * KNOT_S)
        x, y, heading = np.array([_on_rectangle(s, sides_m) for s in way]).T
        wander = _slow_waves(rng, len(way), 3) * np.minimum(1.0, np.maximum(0.0, np.array(way) - start_m))[:, None]
        aside, up, glance = (wander * [0.2, plan.height_spread_m, np.deg2rad(10.0)]).T
        z = np.full(len(way), low + plan.hover_height_m)
        z[: len(risen)] = risen
        return np.column_stack([x - aside * np.sin(heading), y + aside * np.cos(heading), z + up, heading + glance])

    return path


def _to_corner(way_m: float, sides_m: tuple[float, float]) -> float:
    """Distance along a rectangle from a place on it to its nearest corner."""
    corners = np.cumsum([0.0, *sides_m, *sides_m])
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


def _slow_waves(rng: Rng, count: int, columns: int) -> FloatArray:
    """Smooth random curves within -1 and 1, ``(count, columns)``, one value every `KNOT_S`."""
    frequency, phase = rng.uniform(0.03, 0.12, (3, columns)), rng.uniform(0.0, 2.0 * np.pi, (3, columns))
    time_s = KNOT_S * np.arange(count)
    return np.sin(2.0 * np.pi * frequency * time_s[:, None, None] + phase).mean(axis=1)


def _cruise(rng: Rng, world: World, rows: list[list[float]], duration_s: float, plan: FlightPlan) -> FloatArray:
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
    turns = np.deg2rad([0, 25, -25, 50, -50, 75, -75, 105, -105, 140, -140, 180])
    return yaw + float(max(turns, key=lambda turn: _free_steps(world, p_w, yaw + turn, reach, 0.1)))


def _free_steps(world: World, p_w: FloatArray, yaw: float, reach: FloatArray, least_m: float) -> int:
    """Distances ``reach`` [m] in a direction up to the first that is nearer than ``least_m`` to something."""
    ray = p_w + reach[:, None] * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return int(np.append(world.clearance(ray) < least_m, True).argmax())


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _free_place(rng: Rng, world: World, plan: FlightPlan) -> FloatArray:
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


def _open_direction(rng: Rng, world: World, p_w: FloatArray) -> float:
    """Among some headings, the one with the longest free flight."""
    yaws = rng.uniform(-np.pi, np.pi) + np.arange(12) * (np.pi / 6)
    reach = np.arange(0.3, 8.0, 0.3)
    return float(max(yaws, key=lambda yaw: _free_steps(world, p_w, yaw, reach, 0.3)))


def _next_place(rng: Rng, world: World, here: FloatArray, heading: float, plan: FlightPlan) -> FloatArray:
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
