"""What hangs on walls and stands along them, chosen and placed at random; lamps and rugs."""

from collections.abc import Sequence

import numpy as np

from edgeslam_torch.synthetic.house.pieces import build, drawn, furniture, stand
from edgeslam_torch.synthetic.house.scene import Place, Scene
from edgeslam_torch.synthetic.house.world import to_boxes
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator


def line_wall(scene: Scene, place: Place, length: float, rng: Rng) -> None:
    """Doors, notices, radiators and a few things left standing along a corridor's wall."""
    x = -length / 2 + rng.uniform(0.3, 0.9)
    while x < length / 2 - 1.1:
        share = rng.random()
        if share < 0.42:
            build(scene, place.at(x + 0.5, 0.0), rng, "door")
            x += 1.1
        elif share < 0.72:
            kind = str(rng.choice(("poster", "picture", "poster", "whiteboard")))
            x += build(scene, place, rng, kind, x=x)["wide"]
        elif share < 0.84:
            build(scene, place.at(x + 0.45, 0.0), rng, "radiator")
            x += 1.0
        else:
            name = str(rng.choice(["shelf", "cupboard", "bin", "plant", "cartons", "chair"]))
            width, depth = np.minimum(drawn(rng, name), (0.9, 0.45)).tolist()
            stand(scene, place.at(x + width / 2 + 0.05, 0.02), rng, name, width, depth)
            x += width + 0.1
        x += rng.uniform(0.15, 0.7)


def furnish_wall(
    scene: Scene,
    place: Place,
    length: float,
    rng: Rng,
    *,
    density: float,
    door: bool,
    pictures: float,
    names: Sequence[str] = (),
) -> None:
    """Walk along a wall: door, windows, furniture where it fits; then pictures where the upper wall is free.

    ``density`` is the share of the wall that is furnished, ``pictures`` of its free upper part that is hung;
    ``names`` are the furniture to choose from, all of it when empty.
    """
    names = names or list(furniture())
    x = -length / 2 + 0.1
    door_x = rng.uniform(-0.5, 0.5) * max(length - 1.4, 0.0) if door and length > 1.8 else np.inf
    taken: list[tuple[float, float]] = []
    while x < length / 2 - 0.5:
        if x + 0.9 > door_x - 0.6 and x < door_x + 0.6:
            build(scene, place.at(door_x, 0.0), rng, "door")
            taken.append((door_x - 0.6, door_x + 0.6))
            x = door_x + 0.65
            continue
        room_left = (length / 2 if x > door_x else min(length / 2, door_x - 0.6)) - x - 0.08
        if rng.random() > density or room_left < 0.4:
            if rng.random() < 0.5 and room_left > 2.2:
                width = build(scene, place.at(x + 1.1, 0.0), rng, "window")["wide"]
                taken.append((x + 0.7 - width / 2, x + 1.5 + width / 2))
                x += 2.2
            else:
                x += rng.uniform(0.3, 0.9)
            continue
        name = str(rng.choice(names))
        width, depth = drawn(rng, name)
        spot = place.at(x + width / 2, 0.03)
        if width > room_left or not fits(scene, spot, width, depth + furniture()[name].get("front", 0.0)):
            x += rng.uniform(0.15, 0.4)
            continue
        before = len(scene.boxes)
        stand(scene, spot, rng, name, width, depth)
        top = max((b.centre_w[2] + b.half_m[2] for b in scene.boxes[before:]), default=0.0)
        if top > 1.2:
            taken.append((x, x + width))
        elif width > 1.0 and rng.random() < 0.15:
            pane = build(scene, place.at(x + width / 2, 0.0), rng, "window")["wide"]
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
            x += build(scene, place, rng, str(rng.choice(kinds)), x=x)["wide"] + rng.uniform(0.1, 0.7)
        else:
            x += 0.6


def fits(scene: Scene, place: Place, width: float, depth: float) -> bool:
    """Whether a footprint is inside the room and free of solids, sampled every 20 cm or finer."""
    xs = np.linspace(-width / 2, width / 2, max(3, int(width / 0.2)))
    ys = np.linspace(0.0, depth, max(3, int(depth / 0.2)))
    p = np.array([place.point(np.array([x, y, z])) for x in xs for y in ys for z in (0.2, 0.6)])
    if np.any(p[:, :2] < scene.low_w[:2] - 0.01) or np.any(p[:, :2] > scene.high_w[:2] + 0.01):
        return False
    return bool(np.all(to_boxes(scene.boxes)(p) > 0.03))


def lamps_anywhere(scene: Scene, rng: Rng) -> None:
    """One to four lamps under the ceiling, some of them seen as bright panels."""
    low, high = scene.low_w, scene.high_w
    for _ in range(int(rng.integers(1, 5))):
        x, y = rng.uniform(low[:2] + 0.3 * (high - low)[:2] * 0.5, high[:2] - 0.3 * (high - low)[:2] * 0.5)
        lamp = np.array([x, y, high[2] - rng.uniform(0.05, 0.3)])
        scene.lamps_w.append(lamp)
        if rng.random() < 0.6:
            hang_lamp(scene, rng, lamp, float(rng.uniform(0.3, 1.2)), float(rng.uniform(0.15, 0.4)))


def hang_lamp(scene: Scene, rng: Rng, lamp: FloatArray, width: float, depth: float) -> None:
    """Shining panel just under the ceiling."""
    place = Place(float(lamp[0]), float(lamp[1]), 0.0, float(scene.high_w[2]))
    build(scene, place, rng, "shining_panel", width=width, depth=depth)


def rug(scene: Scene, rng: Rng, x: float, y: float) -> None:
    """A rug that lies almost straight."""
    build(scene, Place(float(x), float(y), float(rng.normal(0.0, 0.1))), rng, "rug")
