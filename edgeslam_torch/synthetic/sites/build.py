"""The named sites: seeded layouts with a start, a goal and exits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.synthetic.house.rooms import FLOORS, TEXTURED_WALLS, furnish_wall, hang_lamp, line_wall, shell
from edgeslam_torch.synthetic.house.scene import Place, Scene, random_paint
from edgeslam_torch.synthetic.house.world import Box
from edgeslam_torch.synthetic.sites.mirror import mirrored
from edgeslam_torch.synthetic.sites.obstacles import connected, stand_in_the_way
from edgeslam_torch.synthetic.sites.people import Walker, walker
from edgeslam_torch.synthetic.sites.site import Site, TrueExit
from edgeslam_torch.synthetic.sites.solids import Solids
from edgeslam_torch.synthetic.sites.walls import DOOR_HEIGHT_M, Opening, wall

Rng = np.random.Generator
HEIGHT_M = 2.6
GOAL_HEIGHT_M = 1.1


@dataclass(slots=True)
class _Layout:
    """A site being built, in its own axes."""

    scene: Scene
    start: tuple[float, float, float]
    """x, y [m] and heading [rad]."""
    path: list[tuple[float, float]]
    """From the start to the goal."""
    exits: list[TrueExit] = field(default_factory=list)
    panes: list[Box] = field(default_factory=list)
    """Glass: solid and not painted."""
    walkers: list[Walker] = field(default_factory=list)
    mirror: bool = False
    """Whether the wall at the high end of x is a mirror."""


def _scene(
    rng: Rng, low: Sequence[float], high: Sequence[float], walls: tuple[str, ...], lamps: Sequence[Sequence[float]]
) -> Scene:
    """Floor, ceiling, outer walls and ceiling lamps."""
    bounds = np.array([*low, 0.0]), np.array([*high, HEIGHT_M])
    scene = shell(rng, *bounds, 0.006, walls=walls, floors=FLOORS)
    scene.ambient = 0.6
    for x, y in lamps:
        scene.lamps_w.append(np.array([x, y, HEIGHT_M - 0.1]))
        hang_lamp(scene, scene.lamps_w[-1], 1.0, 0.3)
    return scene


def _exit(x: float, y: float, normal: tuple[float, float], width_m: float) -> TrueExit:
    return TrueExit(np.array([x, y, DOOR_HEIGHT_M / 2]), np.array([*normal, 0.0]), width_m, DOOR_HEIGHT_M)


def _cluttered_room(rng: Rng) -> _Layout:
    """A furnished room with things of every height in the middle, and a doorway to the landing behind it."""
    long, wide, landing = float(rng.uniform(6.0, 7.0)), float(rng.uniform(4.8, 5.6)), 1.8
    scene = _scene(
        rng, (0.0, 0.0), (long + landing, wide), TEXTURED_WALLS, [(0.3 * long, 0.5 * wide), (0.75 * long, 0.5 * wide),
        (long + 0.9, 0.5 * wide)])  # fmt: skip
    door = Opening(float(rng.uniform(0.3, 0.7)) * wide, float(rng.uniform(0.85, 1.1)))
    wall(scene, rng, np.array([[long, 0.0], [long, wide]]), [door], TEXTURED_WALLS)
    for place, length in (
        (Place(long / 2, 0.0, 0.0), long),
        (Place(long / 2, wide, np.pi), long),
        (Place(0.0, wide / 2, -np.pi / 2), wide),
    ):
        furnish_wall(scene, place.at(0.0, 0.0), length - 1.4, rng, HEIGHT_M, density=0.7, door=False, pictures=0.8)
    start = (0.9, 0.5 * wide, 0.0)
    way = [(0.9, 0.5 * wide), (long - 0.9, door.at_m), (long + 0.5 * landing, door.at_m)]
    stand_in_the_way(scene, rng, (1.8, 0.9), (long - 1.0, wide - 0.9), 5, [start[:2], way[1]])
    return _Layout(scene, start, way, [_exit(long, door.at_m, (1.0, 0.0), door.width_m)])


def _corridor(rng: Rng) -> _Layout:
    """A corridor of 12 m with things left standing, and a doorway at its end."""
    return _straight(rng, TEXTURED_WALLS, dressed=True)


def _blank_walls(rng: Rng) -> _Layout:
    """The same with painted walls and nothing on them."""
    return _straight(rng, ("plaster",), dressed=False)


def _straight(rng: Rng, walls: tuple[str, ...], *, dressed: bool) -> _Layout:
    long, wide, lobby = 12.0, float(rng.uniform(2.0, 2.5)), 2.2
    lamps = [(x, 0.0) for x in np.arange(1.2, long + lobby, 2.6)]
    scene = _scene(rng, (0.0, -wide / 2), (long + lobby, wide / 2), walls, lamps)
    door = Opening(wide / 2 + float(rng.uniform(-0.2, 0.2)), float(rng.uniform(0.85, 1.1)))
    wall(scene, rng, np.array([[long, -wide / 2], [long, wide / 2]]), [door], walls)
    if dressed:
        line_wall(scene, Place(0.5 * long, -wide / 2, 0.0), long - 0.6, rng, HEIGHT_M)
        line_wall(scene, Place(0.5 * long, wide / 2, np.pi), long - 0.6, rng, HEIGHT_M)
    y = door.at_m - wide / 2
    way = [(0.8, 0.0), (long - 0.8, y), (long + 0.5 * lobby, y)]
    return _Layout(scene, (0.8, 0.0, 0.0), way, [_exit(long, y, (1.0, 0.0), door.width_m)])


def _l_corridor(rng: Rng) -> _Layout:
    """A corridor that turns left; straight on it ends after two metres."""
    wide, first, second, stub = float(rng.uniform(1.9, 2.3)), float(rng.uniform(6.0, 7.5)), 5.5, 2.2
    scene = _branched(rng, wide, first, stub, second)
    y = wide / 2 + second - 1.0
    way = [(0.8, 0.0), (first + wide / 2, 0.0), (first + wide / 2, y)]
    return _Layout(scene, (0.8, 0.0, 0.0), way)


def _t_corridor(rng: Rng) -> _Layout:
    """A corridor that meets another; the goal is in one of its arms."""
    wide, first, arm = float(rng.uniform(1.9, 2.3)), float(rng.uniform(5.0, 6.5)), 5.0
    scene = _branched(rng, wide, first, 0.0, arm, both=True)
    side = 1.0 if rng.random() < 0.5 else -1.0
    way = [(0.8, 0.0), (first + wide / 2, 0.0), (first + wide / 2, side * (wide / 2 + arm - 1.0))]
    return _Layout(scene, (0.8, 0.0, 0.0), way)


def _branched(rng: Rng, wide: float, first: float, stub: float, arm: float, *, both: bool = False) -> Scene:
    """Corridors along x and y as what solid blocks leave free; doors and pictures on the long walls."""
    low = (0.0, -wide / 2 - (arm if both else 0.0))
    high = (first + wide + stub, wide / 2 + arm)
    lamps = [(x, 0.0) for x in np.arange(1.2, high[0], 2.6)]
    lamps += [(first + wide / 2, y) for y in np.arange(wide / 2 + 1.4, high[1], 2.6)]
    if both:
        lamps += [(first + wide / 2, -y) for y in np.arange(wide / 2 + 1.4, high[1], 2.6)]
    scene = _scene(rng, low, high, TEXTURED_WALLS, lamps)
    blocks = [((0.0, first), (wide / 2, high[1]))]
    if stub > 0:
        blocks.append(((first + wide, high[0]), (wide / 2, high[1])))
    if both:
        blocks.append(((0.0, first), (low[1], -wide / 2)))
    for x, y in blocks:
        _solid_block(scene, rng, x, y)
    line_wall(scene, Place(first / 2, wide / 2, np.pi), first - 0.6, rng, HEIGHT_M)
    line_wall(scene, Place(first / 2, -wide / 2, 0.0), first - 0.6, rng, HEIGHT_M)
    if stub == 0:
        line_wall(scene, Place(first + wide, 0.0, np.pi / 2), 2 * arm + wide - 0.6, rng, HEIGHT_M)
    else:
        line_wall(scene, Place(first + wide, (wide + arm) / 2, np.pi / 2), arm - 0.6, rng, HEIGHT_M)
    return scene


def _solid_block(scene: Scene, rng: Rng, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Rooms that one cannot look into: a solid block up to the ceiling."""
    paint = {face: random_paint(rng, TEXTURED_WALLS) for face in "frbl"}
    centre = (0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), HEIGHT_M / 2)
    scene.box(Place(0.0, 0.0, 0.0), centre, (x[1] - x[0], y[1] - y[0], HEIGHT_M), paint["f"], "wall", faces="frbl",
              special=paint)  # fmt: skip


def _two_rooms(rng: Rng) -> _Layout:
    """Two furnished rooms, an open door between them and a closed one beside it."""
    half, wide = float(rng.uniform(4.2, 4.8)), float(rng.uniform(4.4, 5.2))
    scene = _scene(rng, (0.0, 0.0), (2 * half, wide), TEXTURED_WALLS, [(0.5 * half, wide / 2), (1.5 * half, wide / 2)])
    open_at, closed_at = (0.3, 0.72) if rng.random() < 0.5 else (0.72, 0.3)
    open_door = Opening(open_at * wide, float(rng.uniform(0.85, 1.0)), leaf_rad=float(rng.uniform(1.6, 1.8)))
    closed_door = Opening(closed_at * wide, 0.9, leaf_rad=0.0)
    doors = sorted((open_door, closed_door), key=lambda door: door.at_m)
    wall(scene, rng, np.array([[half, 0.0], [half, wide]]), doors, TEXTURED_WALLS)
    for centre, yaw, length in (
        ((half / 2, 0.0), 0.0, half), ((half / 2, wide), np.pi, half), ((1.5 * half, 0.0), 0.0, half),
        ((1.5 * half, wide), np.pi, half), ((2 * half, wide / 2), np.pi / 2, wide),
    ):  # fmt: skip
        furnish_wall(scene, Place(*centre, yaw), length - 1.8, rng, HEIGHT_M, density=0.7, door=False, pictures=0.8)
    way = [(0.8, wide / 2), (half - 0.9, open_door.at_m), (half + 0.9, open_door.at_m), (2 * half - 1.3, wide / 2)]
    return _Layout(scene, (0.8, wide / 2, 0.0), way, [_exit(half, open_door.at_m, (1.0, 0.0), open_door.width_m)])


def _glass(rng: Rng) -> _Layout:
    """The corridor with a pane of glass half way, from one wall to its middle."""
    layout = _straight(rng, TEXTURED_WALLS, dressed=True)
    wide = float(layout.scene.high_w[1] - layout.scene.low_w[1])
    side = 1.0 if rng.random() < 0.5 else -1.0
    pane = Box(np.array([6.0, side * wide / 4, HEIGHT_M / 2]), np.array([0.006, wide / 4, HEIGHT_M / 2]))
    layout.panes.append(pane)
    return layout


def _mirror(rng: Rng) -> _Layout:
    """The corridor that turns left; its dead end is a mirror from wall to wall."""
    layout = _l_corridor(rng)
    layout.mirror = True
    return layout


def _people(rng: Rng) -> _Layout:
    """The corridor with a person who walks along one side of it, and one who crosses it."""
    layout = _straight(rng, TEXTURED_WALLS, dressed=False)
    side = 0.55 if rng.random() < 0.5 else -0.55
    across = float(rng.uniform(7.5, 9.5))
    layout.walkers.append(walker(rng, np.array([[3.5, side], [10.5, side]]), float(rng.uniform(0.5, 0.9))))
    layout.walkers.append(walker(rng, np.array([[across, -0.6], [across, 0.6]]), float(rng.uniform(0.3, 0.6))))
    return layout


def _doors(rng: Rng) -> _Layout:
    """A corridor with five doors to rooms on its left; two stand open, and the goal is behind the farther one."""
    long, wide, deep, apart = 10.5, float(rng.uniform(2.0, 2.4)), 2.8, 2.1
    lamps = [(x, y) for x in np.arange(apart / 2, long, apart) for y in (0.0, (wide + deep) / 2)]
    scene = _scene(rng, (0.0, -wide / 2), (long, wide / 2 + deep), TEXTURED_WALLS, lamps)
    is_open = set(rng.choice([1, 2, 3, 4], 2, replace=False).tolist())
    doors = [
        Opening(
            (k + 0.5) * apart + float(rng.uniform(-0.15, 0.15)),
            float(rng.uniform(0.85, 1.0)),
            leaf_rad=float(rng.uniform(1.6, 1.8)) if k in is_open else 0.0,
        )
        for k in range(5)
    ]
    wall(scene, rng, np.array([[0.0, wide / 2], [long, wide / 2]]), doors, TEXTURED_WALLS)
    for k in range(1, 5):
        x = k * apart
        wall(scene, rng, np.array([[x, wide / 2], [x, wide / 2 + deep]]), (), TEXTURED_WALLS)
    line_wall(scene, Place(long / 2, -wide / 2, 0.0), long - 0.6, rng, HEIGHT_M)
    goal = doors[max(is_open)].at_m
    way = [(0.8, 0.0), (goal, 0.0), (goal, wide / 2 + 0.6 * deep)]
    exits = [_exit(doors[k].at_m, wide / 2, (0.0, 1.0), doors[k].width_m) for k in sorted(is_open)]
    return _Layout(scene, (0.8, 0.0, 0.0), way, exits)


SITES: dict[str, Callable[[Rng], _Layout]] = {
    "cluttered_room": _cluttered_room,
    "corridor": _corridor,
    "l_corridor": _l_corridor,
    "two_rooms": _two_rooms,
    "blank_walls": _blank_walls,
    "t_corridor": _t_corridor,
    "doors": _doors,
    "glass": _glass,
    "mirror": _mirror,
    "people": _people,
}
"""The first five are static and judged; glass, mirror and people are flown, and nothing is promised."""
JUDGED = tuple(SITES)[:5]


def named_site(name: str, seed: int) -> Site:
    """Build a site; the same name and seed give the same site.

    Raises:
        ValueError: If the name is unknown or the seed negative.
    """
    if name not in SITES:
        raise ValueError(f"unknown world {name!r}; there are {', '.join(SITES)}")
    if seed < 0:
        raise ValueError(f"a seed is at least 0, got {seed}")
    rng = np.random.default_rng([*name.encode(), seed])
    layout = _flyable(SITES[name], rng)
    world = layout.scene.world(name)
    if layout.mirror:
        world = mirrored(world)
    x, y, yaw = layout.start
    T_site_w = np.eye(4)
    T_site_w[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T_site_w[:2, 3] = x, y
    T_w_site = se3.inverse(T_site_w)
    path = np.array([[*xy, GOAL_HEIGHT_M] for xy in layout.path]) @ T_w_site[:3, :3].T + T_w_site[:3, 3]
    exits = tuple(
        TrueExit(T_w_site[:3, :3] @ e.centre_w + T_w_site[:3, 3], T_w_site[:3, :3] @ e.normal_w, e.width_m, e.height_m)
        for e in layout.exits
    )
    solids = Solids(world, layout.panes)
    return Site(name, seed, world, solids, T_site_w, path[-1], exits, path[:, :2], tuple(layout.walkers))


def _flyable(build: Callable[[Rng], _Layout], rng: Rng) -> _Layout:
    """The first layout that leaves a way from the start to the goal: furniture at random may stand in a doorway."""
    while True:
        layout = build(rng)
        if connected(layout.scene, layout.path, layout.panes):
            return layout
