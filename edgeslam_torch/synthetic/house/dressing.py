"""What hangs on walls and stands along them: doors, windows, radiators, pictures, furniture; lamps and rugs."""

import numpy as np

from edgeslam_torch.synthetic.house.furniture import PIECES, picture_paint
from edgeslam_torch.synthetic.house.scene import VARIANTS, Paint, Place, Scene, random_paint
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator


def line_wall(scene: Scene, place: Place, length: float, rng: Rng, height_m: float) -> None:
    """Doors, notices, radiators and a few things left standing along a corridor's wall."""
    x = -length / 2 + rng.uniform(0.3, 0.9)
    while x < length / 2 - 1.1:
        kind = rng.random()
        if kind < 0.42:
            blind_door(scene, place.at(x + 0.5, 0.0), rng)
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
            blind_door(scene, place.at(door_x, 0.0), rng)
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
        if width > room_left or not fits(scene, spot, width, depth + piece.front_m):
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


def fits(scene: Scene, place: Place, width: float, depth: float) -> bool:
    """Whether a footprint is inside the room and free of solids, sampled every 20 cm or finer."""
    xs = np.linspace(-width / 2, width / 2, max(3, int(width / 0.2)))
    ys = np.linspace(0.0, depth, max(3, int(depth / 0.2)))
    p = np.array([place.point(np.array([x, y, z])) for x in xs for y in ys for z in (0.2, 0.6)])
    if np.any(p[:, :2] < scene.low_w[:2] - 0.01) or np.any(p[:, :2] > scene.high_w[:2] + 0.01):
        return False
    return all(np.all(box.distance(p) > 0.03) for box in scene.boxes)


def blind_door(scene: Scene, place: Place, rng: Rng) -> None:
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


def lamps_anywhere(scene: Scene, rng: Rng) -> None:
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


def rug(scene: Scene, rng: Rng, x: float, y: float) -> None:
    place = Place(float(x), float(y), float(rng.normal(0.0, 0.1)))
    size = (float(2.0 * rng.uniform(0.6, 1.1)), float(1.4 * rng.uniform(0.6, 1.1)), 0.008)
    top = {"t": picture_paint(rng, "rug")}
    scene.box(place, (0, 0, 0.004), size, Paint("fabric", 0), "rug", special=top, inside=True)
