"""Worlds of scene files: the one builder of rooms, corridors and buildings."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.geometry import se3
from edgeslam_torch.synthetic.house import dressing
from edgeslam_torch.synthetic.house.pieces import build
from edgeslam_torch.synthetic.house.scene import Place, Scene, random_paint
from edgeslam_torch.synthetic.house.values import Values
from edgeslam_torch.synthetic.house.walls import SIDES, Opening, Wall, block, raise_wall, shell, side_of
from edgeslam_torch.synthetic.house.world import Box, World
from edgeslam_torch.synthetic.sites.mirror import mirrored
from edgeslam_torch.synthetic.sites.obstacles import connected, stand_in_the_way
from edgeslam_torch.synthetic.sites.people import Walker, walker
from edgeslam_torch.synthetic.sites.scene_file import Dress, SceneFile, read_scene, scene_path
from edgeslam_torch.synthetic.sites.site import Site, TrueExit
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
GOAL_HEIGHT_M = 1.1
JUDGED = ("cluttered_room", "corridor", "l_corridor", "two_rooms", "blank_walls")
SITES = (*JUDGED, "t_corridor", "doors", "six_rooms", "glass", "mirror", "people")
"""Scenes with a start and a goal. The first five are static and judged; glass, mirror and people are flown, and nothing
is promised."""
_EPS_M = 1e-6
_MAX_M = 200.0
"""Extent of a scene: beyond, the search for a free way takes gigabytes."""
_BESIDE_M = 0.15
"""Kept free on both sides of a door."""
_TRIES = 100
"""Furniture at random may stand in a doorway: another draw has it elsewhere."""
_OPEN_RAD = (1.6, 1.8)
"""How far an open door leaf is turned."""


@dataclass(slots=True)
class _Layout:
    """A scene being built, in its own axes."""

    scene: Scene
    start: list[float]
    """x, y and heading [degrees]."""
    way: list[list[float]] = field(default_factory=list)
    exits: list[TrueExit] = field(default_factory=list)
    gaps: list[Wall] = field(default_factory=list)
    """Parts of walls at which nothing may stand: doors, and where there is no wall."""
    walkers: list[Walker] = field(default_factory=list)


def named_site(name: str, seed: int) -> Site:
    """Build a site from a name or a scene file; the same scene and seed give the same site.

    Raises:
        ConfigError: If there is no such scene, the file is wrong, or the seed negative.
    """
    if seed < 0:
        raise ConfigError(f"a seed is at least 0, got {seed}")
    file = read_scene(scene_path(name))
    rng = np.random.default_rng([*file.name.encode(), seed])
    try:
        if file.start is None or len(file.way) < 1:
            raise ConfigError("start and way are missing: where a drone stands, and how it gets to its goal")
        for _ in range(_TRIES):
            layout = _laid_out(file, rng, {})
            if connected(layout.scene, layout.way):
                break
        else:
            raise ConfigError("nothing leaves a free way of 0.8 m from the start to the goal")
        world = layout.scene.world(file.name)
    except (ConfigError, ValueError, TypeError) as error:
        raise ConfigError(f"{name}: {error}") from error
    if file.mirror:
        world = mirrored(world)
    x, y, heading_deg = layout.start
    c, s = np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))
    T_site_w = np.eye(4)
    T_site_w[:2, :2] = [[c, -s], [s, c]]
    T_site_w[:2, 3] = x, y
    T_w_site = se3.inverse(T_site_w)
    goal = se3.transform(T_w_site, np.array([*layout.way[-1], GOAL_HEIGHT_M]))
    exits = [
        replace(e, centre_w=T_w_site[:3, :3] @ e.centre_w + T_w_site[:3, 3], normal_w=T_w_site[:3, :3] @ e.normal_w)
        for e in layout.exits
    ]
    return Site(file.name, seed, world, T_site_w, goal, tuple(exits), tuple(layout.walkers))


def place(name: str, rng: Rng, **given: float) -> World:
    """A world of a scene to fly about in, without a task; ``given`` replaces values of the file.

    Raises:
        ConfigError: If there is no such scene or the file is wrong.
    """
    return _laid_out(read_scene(scene_path(name)), rng, given).scene.world(name)


def _laid_out(file: SceneFile, rng: Rng, given: dict[str, float]) -> _Layout:
    value = Values(rng, given)
    value.define({name: number for name, number in file.values.items() if name not in given})
    rooms = _rooms(file, value)
    low, high = np.min([r[0] for r in rooms.values()], axis=0), np.max([r[1] for r in rooms.values()], axis=0)
    bounds = np.append(low, 0.0), np.append(high, value(file.height))
    scene = shell(rng, *bounds, value(file.texel), walls=file.walls, one_paint=file.one_paint)
    scene.ambient = value(file.ambient)
    layout = _Layout(scene, value(file.start or (0.0, 0.0, 0.0)))
    solid = [np.array(value((b.x, b.y)), float).T for b in file.block]
    for a, b in solid:
        block(scene, a, b, dict.fromkeys("frbl", random_paint(rng, file.walls)))
    _light(file, scene, rng, value, rooms)
    for a, b in _between(rooms, solid):
        block(scene, a, b, {face: random_paint(rng, file.walls) for face in "frbl"})
    for wall in _walls(file, rng, value, rooms, layout):
        raise_wall(scene, rng, wall, file.walls)
    for rug in file.rug:
        dressing.rug(scene, rng, value(rug.x), value(rug.y))
    for dress in file.dress:
        _dress(layout, rng, dress, file.pieces, value, *_room(rooms, dress.room))
    layout.way = [value(point) for point in file.way]
    for point in (layout.start[:2], *layout.way) if file.start else ():
        if not any((a < point).all() and (point < b).all() for a, b in rooms.values()):
            raise ConfigError(f"start and way: [{point[0]:g}, {point[1]:g}] is in no room")
    for things in file.obstacles:
        a, b = _room(rooms, things.room)
        kept = [(x, y) for x, y in layout.way if a[0] <= x <= b[0] and a[1] <= y <= b[1]]
        (x0, x1), (y0, y1) = value((things.x, things.y))
        stand_in_the_way(scene, rng, (x0, y0), (x1, y1), things.count, kept)
    for glass in file.glass:
        ends = _ends(value(glass.x), value(glass.y))
        half = np.append(np.maximum(0.5 * np.abs(ends[1] - ends[0]), 0.006), 0.5 * bounds[1][2])
        scene.unseen.append(Box(np.append(ends.mean(0), half[2]), half))
    ways = []
    for person in file.person:
        value.define(person.values)
        ways.append(_ends(value(person.x), value(person.y)))
    for person, ends in zip(file.person, ways, strict=True):
        layout.walkers.append(walker(rng, ends, value(person.speed)))
    return layout


def _rooms(file: SceneFile, value: Values) -> dict[str, FloatArray]:
    """Low and high corner ``(2, 2)`` of each room."""
    if not file.room:
        raise ConfigError("there is no [[room]]")
    out: dict[str, FloatArray] = {}
    for room in file.room:
        corners = np.array(value((room.x, room.y)), float).T
        if not (corners[1] - corners[0] > 0.5).all():
            raise ConfigError(f"room {room.name!r}: x and y go from low to high, half a metre at least")
        for other, (a, b) in out.items():
            if (np.minimum(b, corners[1]) - np.maximum(a, corners[0]) > _EPS_M).all():
                raise ConfigError(f"rooms {other!r} and {room.name!r} overlap")
        if room.name in out:
            raise ConfigError(f"two rooms are called {room.name!r}")
        out[room.name] = corners
    corners = np.array(list(out.values()))
    if np.ptp(corners, axis=(0, 1)).max() > _MAX_M:
        raise ConfigError(f"the rooms extend over more than {_MAX_M:g} m")
    reached = {name for door in file.door for name in door.between} | {name for pair in file.open for name in pair}
    for name in (*reached, *out):
        _room(out, name)
        if len(out) > 1 and name not in reached:
            raise ConfigError(f"room {name!r} has no door: add a [[door]] between it and another, or name it in open")
    return out


def _room(rooms: dict[str, FloatArray], name: str) -> FloatArray:
    if name not in rooms:
        raise ConfigError(f"there is no room {name!r}, only {', '.join(rooms)}")
    return rooms[name]


def _light(file: SceneFile, scene: Scene, rng: Rng, value: Values, rooms: dict[str, FloatArray]) -> None:
    """Lamps: those of the file, drawn ones, or one in the middle of each room."""
    if file.random_lamps:
        dressing.lamps_anywhere(scene, rng)
        return
    lamps = [(x, y, lamp.width) for lamp in file.lamps for x in _list(value(lamp.x)) for y in _list(value(lamp.y))]
    for x, y, width in lamps or [(*corners.mean(0), 1.0) for corners in rooms.values()]:
        scene.lamps_w.append(np.array([x, y, scene.high_w[2] - 0.1]))
        dressing.hang_lamp(scene, rng, scene.lamps_w[-1], value(width), 0.3)


def _between(rooms: dict[str, FloatArray], solid: Sequence[FloatArray]) -> list[FloatArray]:
    """Rectangles ``(2, 2)`` that fill what lies within the outer walls and in no room or block."""
    taken = np.array([*rooms.values(), *solid])
    xs, ys = (np.sort(taken[:, :, k], axis=None) for k in (0, 1))
    xs, ys = (v[np.append(True, np.diff(v) > _EPS_M)] for v in (xs, ys))
    out: list[FloatArray] = []
    for x in pairwise(xs):
        for y in reversed(list(pairwise(ys))):
            cell = np.array([x, y]).T
            middle = cell.mean(0)
            if ((taken[:, 0] < middle) & (middle < taken[:, 1])).all(1).any():
                continue
            if out and out[-1][0, 0] == x[0] and out[-1][0, 1] == y[1]:
                out[-1][0, 1] = y[0]
            else:
                out.append(cell)
    return out


def _walls(file: SceneFile, rng: Rng, value: Values, rooms: dict[str, FloatArray], layout: _Layout) -> list[Wall]:
    """Walls between rooms that touch, those along one line as one, with the file's doors; the open ones are exits."""
    shared: dict[frozenset[str], Wall] = {}
    for (a, r), (b, s) in combinations(rooms.items(), 2):
        for axis in (0, 1):
            low, high = max(r[0, 1 - axis], s[0, 1 - axis]), min(r[1, 1 - axis], s[1, 1 - axis])
            for first, second in ((r, s), (s, r)):
                if high - low > _EPS_M and abs(first[1, axis] - second[0, axis]) < _EPS_M:
                    shared[frozenset((a, b))] = Wall(axis, first[1, axis], low, high)
    for pair in file.open:
        if (gap := shared.pop(frozenset(pair), None)) is None:
            raise ConfigError(f"open: rooms {pair[0]!r} and {pair[1]!r} do not touch")
        layout.gaps.append(gap)
    walls: list[Wall] = []
    for part in sorted(shared.values(), key=lambda w: (-w.axis, w.at, w.low)):
        last = walls[-1] if walls else None
        if last and (last.axis, last.at) == (part.axis, part.at) and abs(last.high - part.low) < _EPS_M:
            last.high = part.high
        else:
            walls.append(replace(part))
    for door in file.door:
        value.define(door.values)
        edge = shared.get(frozenset(door.between))
        where = f"door between {' and '.join(map(repr, door.between))}"
        if edge is None:
            raise ConfigError(f"{where}: the rooms do not touch, or are open to each other")
        is_open, at, width, height = (value(v) for v in (door.open, door.at, door.width, door.height))
        leaf = (float(rng.uniform(*_OPEN_RAD)) if is_open else 0.0) if door.leaf or not is_open else None
        if not edge.low < at - width / 2 < at + width / 2 < edge.high:
            raise ConfigError(f"{where}: at {at:g}, {width:g} m wide, is not within {edge.low:g} to {edge.high:g}")
        whole = next(w for w in walls if (w.axis, w.at) == (edge.axis, edge.at) and w.low <= at <= w.high)
        for other in whole.openings:
            if abs(other.at_m - (at - whole.low)) < 0.5 * (other.width_m + width):
                raise ConfigError(f"{where}: overlaps another door")
        whole.openings = sorted([*whole.openings, Opening(at - whole.low, width, height, leaf)], key=lambda o: o.at_m)
        half = 0.5 * width + _BESIDE_M
        layout.gaps.append(Wall(edge.axis, edge.at, at - half, at + half))
        if is_open:
            centre, normal = np.full(3, 0.5 * height), np.zeros(3)
            centre[edge.axis], centre[1 - edge.axis] = edge.at, at
            normal[edge.axis] = 1.0 if layout.start[edge.axis] < edge.at else -1.0
            layout.exits.append(TrueExit(centre, normal, width, height))
    return walls


def _dress(
    layout: _Layout, rng: Rng, dress: Dress, pieces: tuple[str, ...], value: Values, low: FloatArray, high: FloatArray
) -> None:
    """Dress the walls of a room, where they have no door and are not open."""
    scene = layout.scene
    margin = value(dress.margin)

    def feet(side: str) -> list[tuple[Place, float]]:
        """Place and length of the parts of a wall, the longest first."""
        k = SIDES.index(side)
        along, at = k % 2, (high if side in ("east", "north") else low)[1 - k % 2]
        first, last = low[along] + margin, high[along] - margin
        cuts = [(g.low, g.high) for g in layout.gaps if g.axis != along and abs(g.at - at) < _EPS_M]
        cuts = sorted(cut for cut in cuts if cut[0] < last - _EPS_M and cut[1] > first + _EPS_M)
        if not cuts:
            place, length = side_of(low, high, side)
            return [(place, length - 2 * margin)]
        ends = [(a, b) for a, b in zip([first, *(c[1] for c in cuts)], [*(c[0] for c in cuts), last], strict=True)]
        parts = []
        for a, b in sorted(ends, key=lambda e: e[0] - e[1]):
            part = np.array([low, high])
            part[:, along] = a, b
            parts += [side_of(part[0], part[1], side)] if b - a > _EPS_M else []
        return parts

    if dress.style == "doors":
        for _ in range(int(rng.integers(2, 4))):
            for place, length in feet(dress.walls[int(rng.choice(len(dress.walls)))])[:1]:
                build(scene, place.at(rng.uniform(-0.5, 0.5) * (length - 2.0), 0.0), rng, "door")
        return
    order = rng.permutation(len(dress.walls)).tolist() if dress.shuffle else range(len(dress.walls))
    for side in (dress.walls[k] for k in order):
        for n, (place, length) in enumerate(feet(side)):
            if dress.style == "door":
                if n == 0:
                    build(scene, place, rng, "door")
            elif dress.style == "corridor":
                dressing.line_wall(scene, place, length, rng)
            else:
                dressing.furnish_wall(
                    scene, place, length, rng, density=value(dress.density),
                    door=side == dress.door and n == 0, pictures=value(dress.pictures), names=dress.pieces or pieces,
                )  # fmt: skip


def _list(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]


def _ends(x: float | list[float], y: float | list[float]) -> FloatArray:
    """Both ends ``(2, 2)`` of a line along x or y."""
    return np.array([[_list(x)[k], _list(y)[k]] for k in (0, -1)], float)
