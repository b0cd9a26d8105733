"""Seeded worlds: one corridor with doors or four around a block, a furnished room, and varied ones to train depth."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.furniture import PIECES, cartons, chair, clutter, picture_paint, table
from edgeslam_torch.synthetic.house.render import Rendered, render
from edgeslam_torch.synthetic.house.scene import VARIANTS, Paint, Place, Scene, random_paint
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
CLOSE_UPS = 0.35
"""Share of random poses that look at the top of a table or shelf from near."""
WALLS = ("plaster", "plaster", "plaster", "rough_plaster", "wallpaper", "concrete", "bricks", "tiles", "veneer")
FLOORS = ("wood", "wood", "carpet", "carpet", "tiles", "terrazzo", "concrete")
CEILINGS = ("plaster", "plaster", "ceiling_panels", "concrete", "rough_plaster", "veneer")
HOME = ("desk", "desk", "shelf", "shelf", "shelf", "cupboard", "cupboard", "sofa", "table", "plant", "lamp", "cartons")
"""What the demo's room is furnished with: a study full of edges."""
TEXTURED_WALLS = ("rough_plaster", "wallpaper", "bricks", "concrete", "plaster")


def corridor(rng: Rng, *, length_m: float = 14.0, width_m: float = 2.4, height_m: float = 2.7) -> World:
    """A corridor along x from the origin's end, doors on both sides, notices, radiators and a few things left standing.

    The free space is ``[0, length] x [-width / 2, width / 2] x [0, height]``.
    """
    scene = _lit_corridor(rng, length_m, width_m, height_m, TEXTURED_WALLS)
    for wall in range(4):
        place, length = _wall(scene.low_w, scene.high_w, wall)
        if wall in (1, 3):  # the two ends
            _door(scene, place.at(0.0, 0.0), rng)
            continue
        line_wall(scene, place, length, rng, height_m)
    return scene.world("corridor")


BLOCK_M = (11.0, 9.0)
"""Length and breadth of the centre line around `block` [m]: once around is 40 m."""


def block(rng: Rng, *, width_m: float = 2.4, height_m: float = 2.7) -> World:
    """Four corridors around a block of rooms that one cannot look into, centred on the origin.

    Their centre line is a rectangle of `BLOCK_M`; walls and what stands there are as in `corridor`.
    """
    half = 0.5 * np.array(BLOCK_M)
    low, high = np.array([*(-half - width_m / 2), 0.0]), np.array([*(half + width_m / 2), height_m])
    scene = shell(rng, low, high, 0.004, walls=TEXTURED_WALLS, floors=FLOORS)
    scene.ambient = 0.6
    corner = half - width_m / 2
    scene.box(
        Place(0.0, 0.0, 0.0),
        (0.0, 0.0, height_m / 2),
        (2 * float(corner[0]), 2 * float(corner[1]), height_m),
        random_paint(rng, TEXTURED_WALLS),
        "wall",
        faces="frbl",
    )
    for x, y in _along_rectangle(half, 2.6):
        scene.lamps_w.append(np.array([x, y, height_m - 0.1]))
        hang_lamp(scene, scene.lamps_w[-1], 1.1, 0.3)
    for wall in range(4):
        place, length = _wall(low, high, wall)
        line_wall(scene, place, length, rng, height_m)
        place, length = _wall(np.array([*-corner, 0.0]), np.array([*corner, height_m]), wall)
        line_wall(scene, place.at(0.0, 0.0, yaw_rad=np.pi), length, rng, height_m)
    return scene.world("block")


BUILDING_M = (16.0, 4.0)
"""Length and breadth of the line through the rooms of `building` [m]: once around is 40 m."""


def building(rng: Rng, *, side_m: float = 4.0, opening_m: float = 1.3, height_m: float = 2.7) -> World:
    """Ten rooms in two rows of five, centred on the origin; `BUILDING_M` leads through openings from each to the next.

    Args:
        rng: Of materials and what stands and hangs there.
        side_m: Of a room.
        opening_m: Width of the openings, which reach up to the ceiling.
        height_m: Of the rooms.
    """
    half = np.array([2.5 * side_m, side_m])
    scene = shell(rng, np.array([*-half, 0.0]), np.array([*half, height_m]), 0.006, walls=TEXTURED_WALLS, floors=FLOORS)
    scene.ambient = 0.6
    for column in range(-2, 3):
        x = column * side_m
        for y in (-0.5 * side_m, 0.5 * side_m):
            scene.lamps_w.append(np.array([x, y, height_m - 0.1]))
            hang_lamp(scene, scene.lamps_w[-1], 1.1, 0.3)
            _rug(scene, rng, x, y)
            _room_wall(scene, Place(x, 2 * y, 0.0 if y < 0 else np.pi), side_m, rng, height_m)
            if column > -2:
                _partition(scene, Place(x - 0.5 * side_m, y, np.pi / 2), side_m, opening_m, rng, height_m)
        _partition(scene, Place(x, 0.0, 0.0), side_m, opening_m if abs(column) == 2 else 0.0, rng, height_m)
    for side in (-1, 1):
        for y in (-0.5 * side_m, 0.5 * side_m):
            _room_wall(scene, Place(side * float(half[0]), y, side * np.pi / 2), side_m, rng, height_m)
    return scene.world("building")


def _partition(scene: Scene, place: Place, length: float, opening: float, rng: Rng, height_m: float) -> None:
    """A wall between two rooms, around an opening in its middle if it has one; each side has its own paint."""
    width = 0.5 * (length - opening)
    for side in (-1, 1):
        part = place.at(side * 0.5 * (length - width), 0.0)
        paint = {face: random_paint(rng, TEXTURED_WALLS) for face in "fb"}
        scene.box(
            part, (0.0, 0.0, height_m / 2), (width, 0.12, height_m), paint["f"], "wall", faces="frbl", special=paint
        )
        for face in (part.at(0.0, 0.06), part.at(0.0, -0.06, yaw_rad=np.pi)):
            if opening:
                _decorate(scene, face, rng, -0.25 * width, height_m, ("poster", "picture"))
            else:
                _room_wall(scene, face.at(0.0, 0.02), width, rng, height_m)


def _room_wall(scene: Scene, place: Place, length: float, rng: Rng, height_m: float) -> None:
    """Furnished as `room` is."""
    furnish_wall(scene, place, length, rng, height_m, density=0.96, door=False, pictures=0.9, names=HOME)


def _along_rectangle(half: FloatArray, spacing_m: float) -> Iterator[tuple[float, float]]:
    """Points along the sides of a rectangle around the origin with at most this spacing, corners included."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = int(np.ceil(np.linalg.norm(there - here) / spacing_m))
        for k in range(count):
            x, y = here + k / count * (there - here)
            yield float(x), float(y)


def line_wall(scene: Scene, place: Place, length: float, rng: Rng, height_m: float) -> None:
    """Doors, notices, radiators and a few things left standing along a corridor's wall."""
    x = -length / 2 + rng.uniform(0.3, 0.9)
    while x < length / 2 - 1.1:
        kind = rng.random()
        if kind < 0.42:
            _door(scene, place.at(x + 0.5, 0.0), rng)
            x += 1.1
        elif kind < 0.72:
            x += _decorate(scene, place, rng, x, height_m, ("poster", "picture", "poster", "whiteboard"))
        elif kind < 0.84:
            _radiator(scene, place.at(x + 0.45, 0.0), rng)
            x += 1.0
        else:
            name = str(rng.choice(["shelf", "cupboard", "bin", "plant", "cartons", "chair"]))
            piece = PIECES[name]
            width = min(float(rng.uniform(*piece.width_m)), 0.9)
            depth = min(float(rng.uniform(*piece.depth_m)), 0.45)
            piece.build(scene, place.at(x + width / 2 + 0.05, 0.02), rng, width, depth)
            x += width + 0.1
        x += rng.uniform(0.15, 0.7)


def blank_corridor(rng: Rng, *, length_m: float = 14.0, width_m: float = 2.4, height_m: float = 2.7) -> World:
    """The same corridor with painted walls and nothing on them but a door at each end and two or three at the sides."""
    scene = _lit_corridor(rng, length_m, width_m, height_m, ("plaster",))
    for wall in (1, 3):
        _door(scene, _wall(scene.low_w, scene.high_w, wall)[0].at(0.0, 0.0), rng)
    for _ in range(int(rng.integers(2, 4))):
        place, length = _wall(scene.low_w, scene.high_w, int(rng.choice([0, 2])))
        _door(scene, place.at(rng.uniform(-0.5, 0.5) * (length - 2.0), 0.0), rng)
    return scene.world("blank corridor")


def _lit_corridor(rng: Rng, length_m: float, width_m: float, height_m: float, walls: tuple[str, ...]) -> Scene:
    """A corridor's shell with lamps along its ceiling."""
    low, high = np.array([0.0, -width_m / 2, 0.0]), np.array([length_m, width_m / 2, height_m])
    scene = shell(rng, low, high, 0.004, walls=walls, floors=FLOORS, one_wall_paint=True)
    scene.ambient = 0.6
    scene.lamps_w = [np.array([x, 0.0, height_m - 0.1]) for x in np.arange(1.2, length_m, 2.6)]
    for lamp in scene.lamps_w:
        hang_lamp(scene, lamp, 1.1, 0.3)
    return scene


def room(rng: Rng, *, size_m: tuple[float, float, float] = (6.5, 5.2, 2.7)) -> World:
    """A furnished living or work room centred on the origin, free in the middle."""
    half = np.array([size_m[0] / 2, size_m[1] / 2])
    low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], size_m[2]])
    scene = shell(rng, low, high, 0.004, walls=TEXTURED_WALLS, floors=FLOORS)
    _lamps(scene, rng)
    scene.ambient = 0.55
    _rug(scene, rng, 0.0, 0.0)
    for wall in rng.permutation(4).tolist():
        place, length = _wall(low, high, wall)
        furnish_wall(scene, place, length, rng, size_m[2], density=0.96, door=wall == 0, pictures=0.9, names=HOME)
    return scene.world("room")


def random_room(rng: Rng, *, texel_m: float = 0.006) -> World:
    """An indoor place of random size, layout, materials and light, for training depth."""
    if rng.random() < 0.12:
        length, width = rng.uniform(5.0, 12.0), rng.uniform(1.5, 2.8)
        size = np.array([length, width, rng.uniform(2.2, 3.2)])
    else:
        size = np.array([*np.exp(rng.uniform(np.log(2.3), np.log(8.5), 2)), rng.uniform(2.2, 3.4)])
        size[1] = min(size[1], 9.0)
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    scene = shell(rng, low, high, texel_m, walls=WALLS, floors=FLOORS)
    _lamps(scene, rng)
    scene.ambient = float(rng.uniform(0.35, 0.85))
    scene.exposure = float(np.exp(rng.normal(-0.05, 0.22)))
    warmth = rng.normal(0.0, 0.1)
    scene.light_bgr = (float(np.exp(-warmth)), 1.0, float(np.exp(warmth)))
    density, pictures = float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.0, 0.8))
    for wall in range(4):
        place, length = _wall(low, high, wall)
        furnish_wall(scene, place, length, rng, size[2], density=density, door=rng.random() < 0.35, pictures=pictures)
    for _ in range(int(rng.poisson(size[0] * size[1] / 14.0))):
        _in_the_middle(scene, rng)
    if rng.random() < 0.4:
        _rug(scene, rng, rng.uniform(-0.2, 0.2) * size[0], rng.uniform(-0.2, 0.2) * size[1])
    if rng.random() < 0.25:
        _floating_clutter(scene, rng)
    return scene.world("random room")


def random_pose(rng: Rng, world: World) -> FloatArray:
    """A camera pose ``T_w_c`` in free space, 0.3 to 2.2 m high, mostly near level, at times steeply tilted."""
    low, high = world.bounds_w
    best, best_clearance = 0.5 * (low + high), -np.inf
    ceiling = min(2.2, high[2] - 0.25)
    if rng.random() < CLOSE_UPS:
        T_w_c = _close_up(rng, world, ceiling)
        if T_w_c is not None:
            return T_w_c
    for _ in range(40):
        margin = np.minimum(0.3, 0.25 * (high - low))
        p = rng.uniform(low + margin, high - margin)
        p[2] = np.clip(rng.normal(1.3, 0.4), 0.3, ceiling)
        clearance = float(world.clearance(p))
        if clearance > best_clearance:
            best, best_clearance = p, clearance
        if clearance > 0.3:
            break
    steep = rng.random() < 0.2
    yaw = rng.uniform(-np.pi, np.pi)
    pitch = rng.normal(0.15, 0.45 if steep else 0.18)  # positive looks down
    roll = rng.normal(0.0, 0.35 if steep else 0.06)
    return look(best, yaw, float(np.clip(pitch, -1.0, 1.3)), roll)


def _close_up(rng: Rng, world: World, ceiling_m: float) -> FloatArray | None:
    """A view of the top of some table, shelf or box from within arm's reach to two metres; None when none is free."""
    tops = [b for b in world.boxes if b.half_m[:2].max() > 0.15 and 0.3 < b.centre_w[2] + b.half_m[2] < 1.4]
    for _ in range(12 if tops else 0):
        box = tops[int(rng.integers(len(tops)))]
        target = box.centre_w + [*rng.uniform(-0.7, 0.7, 2) * box.half_m[:2], float(box.half_m[2])]
        yaw, distance = rng.uniform(-np.pi, np.pi), float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
        down = float(rng.uniform(0.1, 1.0))
        p = target - distance * np.array([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)])
        if 0.3 < p[2] < ceiling_m and world.clearance(p) > 0.2:
            aim = rng.normal(0.0, 0.12, 2)
            return look(p, yaw + aim[0], down + aim[1], float(rng.normal(0.0, 0.15)))
    return None


def look(p_w: FloatArray, yaw_rad: float, down_rad: float = 0.0, roll_rad: float = 0.0) -> FloatArray:
    """Pose ``T_w_c`` of a camera at ``p_w`` that looks along ``yaw``, tilted down, rolled clockwise."""
    cy, sy, cd, sd = np.cos(yaw_rad), np.sin(yaw_rad), np.cos(down_rad), np.sin(down_rad)
    forward = np.array([cy * cd, sy * cd, -sd])
    right = np.array([sy, -cy, 0.0])
    down = np.cross(forward, right)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    T_w_c = np.eye(4)
    T_w_c[:3, :3] = np.stack([cr * right + sr * down, cr * down - sr * right, forward], axis=1)
    T_w_c[:3, 3] = p_w
    return T_w_c


def random_view(rng: Rng, camera: Camera, world: World | None = None) -> Rendered:
    """An exact view from a sensible place of ``world`` (a new `random_room` if None).

    A quick look at 40 x 30 pixels rejects views that stare at something nearer than arm's length.
    """
    world = world or random_room(rng)
    small = replace(camera, distortion=(0.0,) * 5).scaled(40, 30)
    for _ in range(12):
        T_w_c = random_pose(rng, world)
        depth = render(world, small, T_w_c, antialias=False).depth_m
        if np.percentile(depth, 10) > 0.35 and np.median(depth) > 0.7:
            break
    return render(world, camera, T_w_c)


def random_views(rng: Rng, camera: Camera, *, views_per_room: int = 32) -> Iterator[Rendered]:
    """Endless views of endless rooms; a room is kept for ``views_per_room`` of them, which spreads its cost."""
    while True:
        world = random_room(rng)
        for _ in range(views_per_room):
            yield random_view(rng, camera, world)


def shell(
    rng: Rng,
    low: FloatArray,
    high: FloatArray,
    texel_m: float,
    *,
    walls: tuple[str, ...],
    floors: tuple[str, ...],
    one_wall_paint: bool = False,
) -> Scene:
    """Floor, ceiling, walls and skirting boards."""
    scene = Scene(low, high, texel_m)
    (x0, y0, z0), (x1, y1, z1) = low, high
    floor, ceiling = random_paint(rng, floors, turned=bool(rng.random() < 0.5)), random_paint(rng, CEILINGS)
    scene.surface([x0, y1, z0], [x1 - x0, 0, 0], [0, y0 - y1, 0], floor, "floor")  # type: ignore[arg-type]
    scene.surface([x0, y0, z1], [x1 - x0, 0, 0], [0, y1 - y0, 0], ceiling, "ceiling")  # type: ignore[arg-type]
    paint = random_paint(rng, walls)
    skirting = random_paint(rng, ("veneer", "plaster", "metal"))
    tall = float(rng.uniform(0.06, 0.14))
    for wall in range(4):
        place, length = _wall(low, high, wall)
        if not one_wall_paint and rng.random() < 0.3:
            paint = random_paint(rng, walls)
        scene.panel(place, (0, 0, (z1 - z0) / 2), length, z1 - z0, paint, "wall")
        scene.box(place, (0, 0.007, tall / 2), (length, 0.014, tall), skirting, "skirting", faces="ft", inside=True)
    return scene


def _wall(low: FloatArray, high: FloatArray, wall: int) -> tuple[Place, float]:
    """Place at the foot of a wall's middle, facing inwards, and the wall's length; 0 and 2 run along x."""
    cx, cy = 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])
    if wall == 0:
        return Place(cx, low[1], 0.0, low[2]), float(high[0] - low[0])
    if wall == 1:
        return Place(high[0], cy, np.pi / 2, low[2]), float(high[1] - low[1])
    if wall == 2:
        return Place(cx, high[1], np.pi, low[2]), float(high[0] - low[0])
    return Place(low[0], cy, -np.pi / 2, low[2]), float(high[1] - low[1])


def _door(scene: Scene, place: Place, rng: Rng) -> None:
    """Leaf in a frame that stands out of the wall."""
    width, height, frame = float(rng.uniform(0.82, 0.95)), float(rng.uniform(1.98, 2.08)), 0.07
    scene.panel(place, (0, 0.008, height / 2), width, height, picture_paint(rng, "door"), "door")
    paint = random_paint(rng, ("veneer", "plaster", "metal"))
    for x in (-(width + frame) / 2, (width + frame) / 2):
        scene.box(place, (x, 0.02, height / 2), (frame, 0.04, height), paint, "door frame", faces="frl", inside=True)
    lintel = (width + 2 * frame, 0.04, frame)
    scene.box(place, (0, 0.02, height + frame / 2), lintel, paint, "door frame", faces="frltu",
              inside=True)  # fmt: skip


def _radiator(scene: Scene, place: Place, rng: Rng) -> None:
    paint = Paint("plaster", int(rng.integers(VARIANTS)))
    size = (float(rng.uniform(0.7, 1.1)), 0.1, float(rng.uniform(0.45, 0.65)))
    scene.box(place, (0, 0.09, 0.15 + size[2] / 2), size, paint, "radiator", faces="frltu",
              special={"f": picture_paint(rng, "radiator")})  # fmt: skip


def _window(scene: Scene, place: Place, rng: Rng, height_m: float) -> float:
    """Bright panes in a frame with a sill; returns its width."""
    width, height = float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.9, 1.4))
    z, frame = min(0.9 + height / 2, height_m - 0.15 - height / 2), 0.06
    view = picture_paint(rng, "window")
    glow = Paint(view.kind, view.variant, tuple(float(1.1 * t) for t in view.tint), glow=True)  # type: ignore[arg-type]
    scene.panel(place, (0, 0.006, z), width, height, glow, "window")
    paint = random_paint(rng, ("plaster", "veneer"))
    for x in (-(width + frame) / 2, (width + frame) / 2):
        scene.box(place, (x, 0.02, z), (frame, 0.04, height), paint, "window frame", faces="frl", inside=True)
    for dz in (-(height + frame) / 2, (height + frame) / 2):
        deep = 0.14 if dz < 0 else 0.04
        scene.box(place, (0, deep / 2, z + dz), (width + 2 * frame, deep, frame), paint, "window frame", faces="frltu",
                  inside=True)  # fmt: skip
    if rng.random() < 0.4:
        cloth = random_paint(rng, ("fabric",), vivid=0.2)
        for side in (-1, 1):
            scene.box(place, (side * (width / 2 + 0.12), 0.1, z - 0.1), (0.34, 0.08, height + 0.5), cloth, "curtain",
                      faces="frltu", inside=True)  # fmt: skip
    return width


def _decorate(
    scene: Scene, place: Place, rng: Rng, x: float, height_m: float, kinds: tuple[str, ...], lowest: float = 1.0
) -> float:
    """Hang something with its left edge at local ``x``; returns its width."""
    kind = str(rng.choice(kinds))
    if kind == "whiteboard":
        width, height = float(rng.uniform(0.9, 1.8)), float(rng.uniform(0.6, 1.1))
    elif kind == "poster":
        width = float(rng.uniform(0.3, 0.7))
        height = width * 4 / 3
    else:
        height = float(rng.uniform(0.25, 0.6))
        width = height * 4 / 3
    bottom = float(np.clip(rng.normal(1.25, 0.15), lowest + 0.05, max(lowest + 0.05, height_m - 0.1 - height)))
    if bottom + height > height_m - 0.05:
        return width
    scene.box(place, (x + width / 2, 0.008, bottom + height / 2), (width, 0.016, height), Paint("metal", 0), kind,
              faces="frltu", special={"f": picture_paint(rng, kind)}, inside=True)  # fmt: skip
    return width


def furnish_wall(
    scene: Scene,
    place: Place,
    length: float,
    rng: Rng,
    height_m: float,
    *,
    density: float,
    door: bool,
    pictures: float,
    names: tuple[str, ...] = tuple(PIECES),
) -> None:
    """Walk along a wall: door, windows, furniture where it fits; then pictures where the upper wall is free.

    ``density`` is the share of the wall that is furnished, ``pictures`` of its free upper part that is hung.
    """
    x = -length / 2 + 0.1
    door_x = rng.uniform(-0.5, 0.5) * max(length - 1.4, 0.0) if door and length > 1.8 else np.inf
    taken: list[tuple[float, float]] = []
    while x < length / 2 - 0.5:
        if x + 0.9 > door_x - 0.6 and x < door_x + 0.6:
            _door(scene, place.at(door_x, 0.0), rng)
            taken.append((door_x - 0.6, door_x + 0.6))
            x = door_x + 0.65
            continue
        room_left = (length / 2 if x > door_x else min(length / 2, door_x - 0.6)) - x - 0.08
        if rng.random() > density or room_left < 0.4:
            if rng.random() < 0.5 and room_left > 2.2:
                width = _window(scene, place.at(x + 1.1, 0.0), rng, height_m)
                taken.append((x + 0.7 - width / 2, x + 1.5 + width / 2))
                x += 2.2
            else:
                x += rng.uniform(0.3, 0.9)
            continue
        piece = PIECES[str(rng.choice(names))]
        width, depth = float(rng.uniform(*piece.width_m)), float(rng.uniform(*piece.depth_m))
        spot = place.at(x + width / 2, 0.03)
        if width > room_left or not _fits(scene, spot, width, depth + piece.front_m):
            x += rng.uniform(0.15, 0.4)
            continue
        before = len(scene.boxes)
        piece.build(scene, spot, rng, width, depth)
        top = max((b.centre_w[2] + b.half_m[2] for b in scene.boxes[before:]), default=0.0)
        if top > 1.2:
            taken.append((x, x + width))
        elif width > 1.0 and rng.random() < 0.15:
            pane = _window(scene, place.at(x + width / 2, 0.0), rng, height_m)
            taken.append((x + width / 2 - pane / 2 - 0.4, x + width / 2 + pane / 2 + 0.4))
        x += width + rng.uniform(0.02, 0.5)
    x = -length / 2 + 0.25
    while x < length / 2 - 0.4:
        blocked = [end for start, end in taken if start < x + 0.9 and end > x]
        if blocked:
            x = max(blocked) + 0.05
        elif rng.random() < pictures:
            ahead = min((start for start, _ in taken if start > x), default=length / 2) - x
            kinds = ("poster", "picture", "whiteboard") if ahead > 1.9 else ("poster", "picture")
            x += _decorate(scene, place, rng, x, height_m, kinds) + rng.uniform(0.1, 0.7)
        else:
            x += 0.6


def _fits(scene: Scene, place: Place, width: float, depth: float) -> bool:
    """Whether a footprint is inside the room and free of solids, sampled every 20 cm or finer."""
    xs = np.linspace(-width / 2, width / 2, max(3, int(width / 0.2)))
    ys = np.linspace(0.0, depth, max(3, int(depth / 0.2)))
    p = np.array([place.point(np.array([x, y, z])) for x in xs for y in ys for z in (0.2, 0.6)])
    if np.any(p[:, :2] < scene.low_w[:2] - 0.01) or np.any(p[:, :2] > scene.high_w[:2] + 0.01):
        return False
    return all(np.all(box.distance(p) > 0.03) for box in scene.boxes)


def _in_the_middle(scene: Scene, rng: Rng) -> None:
    """A table with chairs, cartons or any other piece, standing free."""
    low, high = scene.low_w[:2] + 0.5, scene.high_w[:2] - 0.5
    if np.any(high <= low):
        return
    x, y = rng.uniform(low, high)
    place = Place(float(x), float(y), float(rng.uniform(-np.pi, np.pi)))
    kind = rng.random()
    if kind < 0.4:
        width, depth = float(rng.uniform(0.7, 1.6)), float(rng.uniform(0.6, 1.0))
        if not _fits(scene, place.at(0, -0.5), width, depth + 1.0):
            return
        table(scene, place, rng, width, depth)
        for _ in range(int(rng.integers(1, 4))):
            side = -1 if rng.random() < 0.5 else 1
            y_chair = depth / 2 + side * (depth / 2 + rng.uniform(0.05, 0.3))
            yaw = (np.pi if side > 0 else 0.0) + rng.uniform(-0.5, 0.5)
            chair(scene, place.at(rng.uniform(-0.3, 0.3) * width, y_chair, 0.0, yaw), rng)
    elif kind < 0.7:
        if _fits(scene, place.at(0, -0.4), 0.7, 0.8):
            cartons(scene, place, rng)
    else:
        piece = PIECES[str(rng.choice(list(PIECES)))]
        width, depth = float(rng.uniform(*piece.width_m)), float(rng.uniform(*piece.depth_m))
        if _fits(scene, place, width, depth):
            piece.build(scene, place, rng, width, depth)


def _floating_clutter(scene: Scene, rng: Rng) -> None:
    """Boxes and sheets at any height and angle: depth must not be read off the floor line alone."""
    for _ in range(int(rng.integers(2, 9))):
        p = rng.uniform(scene.low_w + 0.4, scene.high_w - 0.4)
        size = np.exp(rng.uniform(np.log(0.1), np.log(0.8), 3))
        paint = random_paint(rng, ("dead_leaves", "fabric", "wood", "metal", "terrazzo", "wallpaper"), vivid=0.3)
        place = Place(float(p[0]), float(p[1]), float(rng.uniform(-3, 3)), float(p[2]))
        if rng.random() < 0.6:
            scene.box(place, (0, 0, 0), (size[0], size[1], size[2]), paint, "object", faces="frbltu")
        else:
            axes = rng.normal(size=(2, 3))
            u, v = (a / np.linalg.norm(a) * s for a, s in zip(axes, size[:2], strict=True))
            scene.surface(p, u, v, paint, "sheet", two_sided=True)
    width, depth = (scene.high_w - scene.low_w)[:2].tolist()
    clutter(scene, Place(0.0, -0.5 * depth, 0.0), rng, width, depth, 6)


def _lamps(scene: Scene, rng: Rng) -> None:
    """One to four lamps under the ceiling, some of them seen as bright panels."""
    low, high = scene.low_w, scene.high_w
    for _ in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(low[:2] + 0.3 * (high - low)[:2] * 0.5, high[:2] - 0.3 * (high - low)[:2] * 0.5)
        lamp = np.array([x, y, high[2] - rng.uniform(0.05, 0.3)])
        scene.lamps_w.append(lamp)
        if rng.random() < 0.6:
            hang_lamp(scene, lamp, float(rng.uniform(0.3, 1.2)), float(rng.uniform(0.15, 0.4)))


def hang_lamp(scene: Scene, lamp: FloatArray, width: float, depth: float) -> None:
    """Shining panel just under the ceiling."""
    place = Place(float(lamp[0]), float(lamp[1]), 0.0, float(scene.high_w[2]))
    glow = Paint("plaster", 0, (1.7, 1.7, 1.7), glow=True)
    scene.box(place, (0, 0, -0.03), (width, depth, 0.06), glow, "lamp", faces="frblu", inside=True)


def _rug(scene: Scene, rng: Rng, x: float, y: float) -> None:
    place = Place(float(x), float(y), float(rng.normal(0.0, 0.1)))
    size = (float(2.0 * rng.uniform(0.6, 1.1)), float(1.4 * rng.uniform(0.6, 1.1)), 0.008)
    top = {"t": picture_paint(rng, "rug")}
    scene.box(place, (0, 0, 0.004), size, Paint("fabric", 0), "rug", special=top, inside=True)
