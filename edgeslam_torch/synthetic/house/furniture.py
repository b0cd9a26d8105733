"""Furniture and clutter: each function adds one piece to a `Scene` at a `Place` (back at local y = 0, facing +y)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.synthetic.house.scene import VARIANTS, Paint, Place, Scene, random_paint

Rng = np.random.Generator
WOODS = ("veneer", "veneer", "wood", "metal", "plaster")
CLOTHS = ("fabric", "fabric", "carpet", "rough_plaster")


def picture_paint(rng: Rng, kind: str) -> Paint:
    """One of the pictures of a kind, slightly tinted."""
    gain = np.exp(rng.normal(0.0, 0.06, 3))
    return Paint(kind, int(rng.integers(VARIANTS)), (float(gain[0]), float(gain[1]), float(gain[2])))


def table(scene: Scene, place: Place, rng: Rng, width: float, depth: float, height: float = 0.0) -> None:
    """Top and four legs, things on it."""
    height = height or float(rng.uniform(0.68, 0.8))
    paint = random_paint(rng, WOODS)
    thick = float(rng.uniform(0.02, 0.05))
    scene.box(place, (0, depth / 2, height - thick / 2), (width, depth, thick), paint, "table", faces="frbltu")
    leg = float(rng.uniform(0.035, 0.07))
    metal = random_paint(rng, ("metal", "veneer"))
    for x in (-width / 2 + leg, width / 2 - leg):
        for y in (leg, depth - leg):
            scene.box(place, (x, y, (height - thick) / 2), (leg, leg, height - thick), metal, "leg", faces="frbl")
    clutter(scene, place.at(0, 0, height), rng, width, depth, int(rng.integers(2, 6 + int(10 * width * depth))))


def desk(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Table with monitor, keyboard and a chair before it."""
    height = float(rng.uniform(0.7, 0.78))
    table(scene, place, rng, width, depth, height)
    monitor(scene, place.at(rng.uniform(-0.2, 0.2) * width, 0.12, height, rng.uniform(-0.3, 0.3)), rng)
    board = place.at(rng.uniform(-0.1, 0.1) * width, depth - 0.25, height, rng.uniform(-0.15, 0.15))
    scene.box(board, (0, 0, 0.012), (0.44, 0.14, 0.024), Paint("metal", 1, (0.5, 0.5, 0.5)), "keyboard",
              special={"t": picture_paint(rng, "keyboard")})  # fmt: skip
    chair(scene, place.at(rng.uniform(-0.2, 0.2), depth + 0.25, 0.0, np.pi + rng.uniform(-0.6, 0.6)), rng)


def monitor(scene: Scene, place: Place, rng: Rng) -> None:
    """Display on a foot."""
    width = float(rng.uniform(0.42, 0.65))
    case = Paint("metal", int(rng.integers(VARIANTS)), (0.35, 0.35, 0.35))
    scene.box(place, (0, 0.0, 0.01), (0.24, 0.18, 0.02), case, "foot")
    scene.box(place, (0, -0.02, 0.1), (0.05, 0.03, 0.18), case, "foot", faces="frbl")
    view = picture_paint(rng, "screen")
    glowing = Paint(view.kind, view.variant, view.tint, glow=True)
    scene.box(place, (0, 0.02, 0.12 + 0.31 * width), (width, 0.04, 0.6 * width), case, "monitor", faces="frbltu",
              special={"f": glowing})  # fmt: skip


def chair(scene: Scene, place: Place, rng: Rng) -> None:
    """Seat, back and legs; its back at local y = -0.22."""
    seat, leg = float(rng.uniform(0.42, 0.48)), 0.035
    frame, cover = random_paint(rng, ("veneer", "metal")), random_paint(rng, (*CLOTHS, "veneer"))
    scene.box(place, (0, 0, seat - 0.02), (0.44, 0.44, 0.05), cover, "seat", faces="frbltu")
    scene.box(place, (0, -0.21, seat + 0.3), (0.42, 0.03, rng.uniform(0.25, 0.5)), cover, "back", faces="frbltu")
    for x in (-0.2, 0.2):
        for y in (-0.2, 0.2):
            tall = seat + 0.5 if y < 0 else seat - 0.04
            scene.box(place, (x, y, tall / 2), (leg, leg, tall), frame, "leg", faces="frblt")


def shelf(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Open bookcase: case, boards, rows of books set back from the front."""
    height, board = float(rng.uniform(1.0, 2.2)), 0.024
    rows = max(2, round(height / rng.uniform(0.3, 0.42)))
    paint = random_paint(rng, WOODS)
    for x in (-width / 2 + board / 2, width / 2 - board / 2):
        scene.box(place, (x, depth / 2, height / 2), (board, depth, height), paint, "side", faces="frlt")
    scene.panel(place, (0, 0.006, height / 2), width, height, paint, "shelf back")
    step = (height - board) / rows
    for k in range(rows + 1):
        z = k * step + board / 2
        scene.box(place, (0, depth / 2, z), (width - 2 * board, depth, board), paint, "board", faces="ftu")
        if k == rows:
            continue
        if rng.random() < 0.75:
            inner = width - 2 * board
            filled = inner * rng.uniform(0.4, 1.0)
            tall, deep = step * rng.uniform(0.72, 0.9), depth * rng.uniform(0.6, 0.85)
            x = (inner - filled) / 2 * rng.choice([-1, 1])
            scene.box(place, (x, deep / 2 + 0.01, k * step + board + tall / 2), (filled, deep, tall),
                      Paint("plaster", 0), "books", faces="frlt", special={"f": picture_paint(rng, "book_spines")},
                      inside=True)  # fmt: skip
        else:
            clutter(scene, place.at(0, 0.03, k * step + board), rng, width - 0.1, depth - 0.06, 2, step - board - 0.02)
    if rng.random() < 0.5:
        clutter(scene, place.at(0, 0, height), rng, width, depth, 2)


def cupboard(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Closed solid with a front of doors and drawers."""
    height = float(rng.choice([rng.uniform(0.5, 1.1), rng.uniform(1.6, 2.2)]))
    paint = random_paint(rng, WOODS)
    front = Paint("cabinet", int(rng.integers(VARIANTS)), paint.tint)
    scene.box(place, (0, depth / 2, height / 2), (width, depth, height), paint, "cupboard", special={"f": front})
    if height < 1.6 or rng.random() < 0.5:
        clutter(scene, place.at(0, 0, height), rng, width, depth, int(rng.integers(1, 5)))


def sofa(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Seat, back, arms and cushions."""
    cloth = random_paint(rng, CLOTHS, vivid=0.2)
    arm, seat = float(rng.uniform(0.12, 0.22)), float(rng.uniform(0.36, 0.46))
    depth = max(depth, 0.75)
    scene.box(place, (0, depth / 2, seat / 2), (width, depth, seat), cloth, "sofa")
    scene.box(place, (0, 0.11, seat + 0.2), (width, 0.22, 0.4), cloth, "sofa back")
    for x in (-width / 2 + arm / 2, width / 2 - arm / 2):
        scene.box(place, (x, depth / 2 + 0.1, seat + 0.1), (arm, depth - 0.2, 0.2), cloth, "arm")
    for _ in range(int(rng.integers(0, 4))):
        at = place.at(rng.uniform(-0.35, 0.35) * width, 0.32, seat, rng.uniform(-0.5, 0.5))
        scene.box(at, (0, 0, 0.2), (0.4, 0.12, 0.38), random_paint(rng, CLOTHS, vivid=0.12), "cushion")


def bed(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Frame, mattress, blanket, pillows, head board."""
    width, depth = max(width, 0.95), max(depth, 1.9)
    scene.box(place, (0, depth / 2, 0.15), (width, depth, 0.3), random_paint(rng, WOODS), "bed")
    scene.box(place, (0, 0.03, 0.5), (width, 0.06, 1.0), random_paint(rng, WOODS), "head board")
    scene.box(
        place, (0, depth / 2 + 0.02, 0.38), (width * 0.98, depth - 0.06, 0.18), random_paint(rng, CLOTHS), "mattress"
    )
    blanket = random_paint(rng, ("fabric",), vivid=0.1)
    scene.box(place, (0, depth * 0.64, 0.385), (width + 0.02, depth * 0.68, 0.21), blanket, "blanket")
    for x in (-0.25, 0.25):
        at = place.at(x * width, 0.28, 0.47, rng.uniform(-0.2, 0.2))
        scene.box(at, (0, 0, 0.06), (0.45 * width, 0.36, 0.12), random_paint(rng, CLOTHS), "pillow")


def plant(scene: Scene, place: Place, rng: Rng, size: float = 0.0) -> None:
    """Pot, stem and leaves seen from both sides."""
    size = size or float(rng.uniform(0.5, 1.5))
    pot = 0.28 * size
    scene.prism(
        place, 0.14 * size + 0.03, pot, random_paint(rng, ("plaster", "rough_plaster", "terrazzo"), vivid=0.12), "pot"
    )
    scene.box(place, (0, 0, pot + 0.2 * size), (0.03, 0.03, 0.4 * size), Paint("wood", 0, (0.6, 0.7, 0.7)), "stem",
              faces="frbl", inside=True)  # fmt: skip
    green = float(rng.uniform(0.6, 1.2))
    for k in range(int(rng.integers(9, 18))):
        length, width = rng.uniform(0.25, 0.5) * size, rng.uniform(0.06, 0.14) * size
        yaw, rise = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 1.1)
        along = np.array([np.cos(yaw) * np.cos(rise), np.sin(yaw) * np.cos(rise), np.sin(rise)])
        across = np.array([-np.sin(yaw), np.cos(yaw), rng.uniform(-0.3, 0.3)])
        base = np.array([0, 0, pot + rng.uniform(0.1, 0.4) * size])
        paint = Paint("fabric", k % 3, (0.35 * green, 0.9 * green, 0.45 * green))
        origin = place.point(base - 0.5 * width * across)
        scene.surface(
            origin, place.direction(width * across), place.direction(length * along), paint, "leaf", two_sided=True
        )


def floor_lamp(scene: Scene, place: Place, rng: Rng) -> None:
    """Foot, pole and shade."""
    height = float(rng.uniform(1.3, 1.8))
    metal = random_paint(rng, ("metal",))
    scene.prism(place, 0.14, 0.03, metal, "lamp foot")
    scene.box(place, (0, 0, height / 2), (0.025, 0.025, height), metal, "pole", faces="frbl", inside=True)
    shade = random_paint(rng, ("fabric", "plaster"))
    glow = Paint(shade.kind, shade.variant, (1.1, 1.25, 1.3), glow=True)
    scene.prism(place.at(0, 0, height - 0.1), 0.2, 0.28, glow, "shade")


def bin_(scene: Scene, place: Place, rng: Rng) -> None:
    """Waste bin or stool."""
    paint = random_paint(rng, ("metal", "plaster", "veneer"), vivid=0.12)
    scene.prism(place, rng.uniform(0.12, 0.22), rng.uniform(0.25, 0.5), paint, "bin", sides=10)


def cartons(scene: Scene, place: Place, rng: Rng) -> None:
    """A few boxes on top of each other."""
    z, size = 0.0, float(rng.uniform(0.3, 0.6))
    for _ in range(int(rng.integers(1, 4))):
        w, d, h = (float(size * rng.uniform(0.6, 1.0)) for _ in range(3))
        card = Paint("plaster", int(rng.integers(VARIANTS)), (0.5, 0.68, 0.85))
        paint = card if rng.random() < 0.6 else random_paint(rng, ("dead_leaves", "fabric", "metal"), vivid=0.12)
        special = {"f": picture_paint(rng, "poster")} if rng.random() < 0.5 else None
        scene.box(place.at(0, 0, z, rng.uniform(-0.4, 0.4)), (0, 0, h / 2), (w, d, h), paint, "carton", special=special)
        z += h
        size *= 0.85


def counter(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
    """Kitchen: base units, worktop, tiles, wall cupboards, hob or sink, a microwave and many small things."""
    height, top = float(rng.uniform(0.82, 0.92)), 0.04
    paint, worktop = random_paint(rng, WOODS), random_paint(rng, ("terrazzo", "concrete", "veneer", "metal"))
    units = max(1, round(width / 1.2))
    for k in range(units):
        front = Paint("cabinet", int(rng.integers(VARIANTS)), paint.tint)
        x = (k + 0.5) * width / units - width / 2
        size = (width / units, depth - 0.02, height)
        scene.box(place, (x, depth / 2 - 0.01, height / 2), size, paint, "unit", faces="frl", special={"f": front})
    scene.box(place, (0, depth / 2, height + top / 2), (width, depth, top), worktop, "worktop", faces="frltu")
    on_top = place.at(0, 0, height + top)
    tall = float(rng.uniform(0.4, 0.6))
    if rng.random() < 0.7:
        scene.panel(
            on_top, (0, 0.004, tall / 2), width, tall, random_paint(rng, ("tiles", "tiles", "metal")), "splashback"
        )
    if rng.random() < 0.7:
        x, size = float(rng.uniform(-0.3, 0.3) * width), (0.56, 0.46, 0.006)
        dark = Paint("metal", 0, (0.25, 0.25, 0.25)) if rng.random() < 0.5 else Paint("metal", 1, (0.8, 0.8, 0.8))
        scene.box(on_top, (x, depth / 2, 0.003), size, dark, "hob", faces="frlt", inside=True)
    if rng.random() < 0.6:
        x = float(rng.uniform(-0.35, 0.35) * width)
        case = random_paint(rng, ("metal", "plaster"))
        door = Paint("screen", int(rng.integers(VARIANTS)), (0.5, 0.5, 0.5))
        scene.box(on_top, (x, 0.22, 0.14), (0.48, 0.36, 0.28), case, "microwave", special={"f": door})
    clutter(scene, on_top, rng, width, depth, int(rng.integers(3, 6 + int(5 * width))))
    if rng.random() < 0.7:
        upper = float(rng.uniform(0.5, 0.75))
        for k in range(units):
            front = Paint("cabinet", int(rng.integers(VARIANTS)), paint.tint)
            x = (k + 0.5) * width / units - width / 2
            scene.box(on_top, (x, 0.17, tall + upper / 2), (width / units, 0.34, upper), paint, "wall unit",
                      faces="frltu", special={"f": front})  # fmt: skip


def laptop(scene: Scene, place: Place, rng: Rng) -> None:
    """Base with keys and a leaning display."""
    case = Paint("metal", int(rng.integers(VARIANTS)), (0.5, 0.5, 0.5))
    keys = {"t": picture_paint(rng, "keyboard")}
    scene.box(place, (0, 0, 0.01), (0.33, 0.23, 0.02), case, "laptop", special=keys)
    lean, view = float(rng.uniform(0.1, 0.5)), picture_paint(rng, "screen")
    up = np.array([0.0, -np.sin(lean), np.cos(lean)]) * 0.21
    corner = np.array([0.165, -0.115, 0.02]) + up
    u, v = place.direction(np.array([-0.33, 0.0, 0.0])), place.direction(-up)
    glow = Paint(view.kind, view.variant, view.tint, glow=True)
    scene.surface(place.point(corner), u, v, glow, "laptop screen")
    back = np.array([-0.165, -0.117, 0.02]) + up
    scene.surface(place.point(back), -u, v, case, "laptop lid")


def clutter(
    scene: Scene, place: Place, rng: Rng, width: float, depth: float, count: int, headroom: float = 0.5
) -> None:
    """Books, cups, boxes and papers on a top of ``width x depth``."""
    for _ in range(count):
        at = place.at(rng.uniform(-0.42, 0.42) * width, rng.uniform(0.15, 0.85) * depth, 0.0, rng.uniform(-1.5, 1.5))
        kind = rng.random()
        if kind < 0.3:  # a pile of books
            z = 0.0
            for _ in range(int(rng.integers(1, 5))):
                thick = float(rng.uniform(0.015, 0.045))
                if z + thick > headroom:
                    break
                cover = random_paint(rng, ("plaster", "fabric"), vivid=0.15)
                special = {"t": picture_paint(rng, "poster")} if rng.random() < 0.5 else None
                size = (rng.uniform(0.13, 0.2), rng.uniform(0.18, 0.26), thick)
                scene.box(
                    at.at(0, 0, z, rng.uniform(-0.3, 0.3)), (0, 0, thick / 2), size, cover, "book", special=special
                )
                z += thick
        elif kind < 0.5:
            height = min(headroom, float(rng.uniform(0.07, 0.16)))
            scene.prism(
                at, rng.uniform(0.03, 0.05), height, random_paint(rng, ("plaster", "metal"), vivid=0.15), "cup", sides=6
            )
        elif kind < 0.6:
            height = min(headroom, float(rng.uniform(0.18, 0.34)))
            scene.prism(at, 0.04, 0.7 * height, random_paint(rng, ("metal", "plaster"), vivid=0.2), "bottle", sides=6)
            scene.prism(at.at(0, 0, 0.7 * height), 0.018, 0.3 * height, Paint("metal", 0), "neck", sides=6)
        elif kind < 0.85:
            w, d, h = rng.uniform(0.06, 0.3, 3) * [1.0, 0.7, 0.8]
            kinds = ("dead_leaves", "fabric", "plaster", "veneer", "metal")
            special = {"f": picture_paint(rng, "picture")} if rng.random() < 0.5 else None
            h = min(h, headroom)
            scene.box(at, (0, 0, h / 2), (w, d, h), random_paint(rng, kinds, vivid=0.12), "object", special=special)
        elif kind < 0.89 and headroom > 0.3:
            laptop(scene, at, rng)
        else:
            scene.box(at, (0, 0, 0.0015), (0.21, 0.297, 0.003), Paint("plaster", 0), "paper", faces="t",
                      special={"t": picture_paint(rng, "poster")}, inside=True)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Piece:
    """How much floor a piece of furniture takes."""

    build: Callable[[Scene, Place, Rng, float, float], None]
    width_m: tuple[float, float]
    depth_m: tuple[float, float]
    front_m: float = 0.0
    """Floor kept free before it."""


def _small(build: Callable[[Scene, Place, Rng], None]) -> Callable[[Scene, Place, Rng, float, float], None]:
    def centred(scene: Scene, place: Place, rng: Rng, width: float, depth: float) -> None:
        build(scene, place.at(0, depth / 2), rng)

    return centred


PIECES = {
    "desk": Piece(desk, (1.1, 1.8), (0.6, 0.85), 0.6),
    "table": Piece(table, (0.6, 1.8), (0.45, 0.95)),
    "shelf": Piece(shelf, (0.6, 1.4), (0.24, 0.38)),
    "cupboard": Piece(cupboard, (0.5, 1.4), (0.35, 0.6)),
    "counter": Piece(counter, (1.2, 3.0), (0.55, 0.65)),
    "sofa": Piece(sofa, (1.2, 2.2), (0.75, 0.95)),
    "bed": Piece(bed, (0.95, 1.7), (1.9, 2.1)),
    "plant": Piece(_small(plant), (0.5, 0.6), (0.5, 0.6)),
    "lamp": Piece(_small(floor_lamp), (0.4, 0.5), (0.4, 0.5)),
    "bin": Piece(_small(bin_), (0.35, 0.45), (0.35, 0.45)),
    "cartons": Piece(_small(cartons), (0.5, 0.7), (0.5, 0.7)),
    "chair": Piece(_small(chair), (0.55, 0.6), (0.6, 0.7)),
}
