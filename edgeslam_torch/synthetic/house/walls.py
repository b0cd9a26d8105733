"""The walls of a scene: its outer shell, walls with openings and doors between its parts, and solid blocks."""

from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.synthetic.house.pieces import build
from edgeslam_torch.synthetic.house.scene import Paint, Place, Scene, random_paint
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
FLOORS = ("wood", "wood", "carpet", "carpet", "tiles", "terrazzo", "concrete")
CEILINGS = ("plaster", "plaster", "ceiling_panels", "concrete", "rough_plaster", "veneer")
FRAMES = ("veneer", "plaster", "metal")
SIDES = ("south", "east", "north", "west")
"""Of a rectangle: low y, high x, high y, low x."""
THICK_M = 0.12
DOOR_HEIGHT_M = 2.05


@dataclass(frozen=True, slots=True)
class Opening:
    """A way through a wall, from the floor up."""

    at_m: float
    """Its middle, along the wall from the wall's first end."""
    width_m: float = 0.9
    height_m: float = DOOR_HEIGHT_M
    leaf_rad: float | None = None
    """A door leaf hung at its first side, opened by this angle; None for no leaf, 0 for a closed door."""


@dataclass(slots=True)
class Wall:
    """An upright wall at ``at`` on ``axis``, along the other axis from ``low`` to ``high``."""

    axis: int
    at: float
    low: float
    high: float
    openings: list[Opening] = field(default_factory=list)
    """In order along the wall, without overlap."""


def shell(
    rng: Rng, low: FloatArray, high: FloatArray, texel_m: float, *, walls: tuple[str, ...], one_paint: bool = False
) -> Scene:
    """Floor, ceiling, outer walls and skirting boards between two inner corners ``(3,)`` [m].

    ``walls`` are the materials to choose from; ``one_paint``: all walls have the same paint.
    """
    scene = Scene(low, high, texel_m)
    wide, deep, tall = high - low
    floor, ceiling = random_paint(rng, FLOORS, turned=bool(rng.random() < 0.5)), random_paint(rng, CEILINGS)
    x, y = np.array([wide, 0.0, 0.0]), np.array([0.0, deep, 0.0])
    scene.surface(np.array([low[0], high[1], low[2]]), x, -y, floor, "floor")
    scene.surface(np.array([low[0], low[1], high[2]]), x, y, ceiling, "ceiling")
    paint, skirting = random_paint(rng, walls), random_paint(rng, FRAMES)
    board = float(rng.uniform(0.06, 0.14))
    for side in SIDES:
        place, length = side_of(low, high, side)
        if not one_paint and rng.random() < 0.3:
            paint = random_paint(rng, walls)
        scene.panel(place, (0, 0, tall / 2), length, tall, paint, "wall")
        scene.box(place, (0, 0.007, board / 2), (length, 0.014, board), skirting, "skirting", faces="ft", inside=True)
    return scene


def side_of(low: FloatArray, high: FloatArray, side: str) -> tuple[Place, float]:
    """Place at the foot of the middle of a rectangle's side, facing inwards, and the side's length."""
    k = SIDES.index(side)
    x, y = 0.5 * (low[:2] + high[:2]).astype(float)
    x, y = ((x, low[1]), (high[0], y), (x, high[1]), (low[0], y))[k]
    return Place(float(x), float(y), (0.0, np.pi / 2, np.pi, -np.pi / 2)[k]), float((high - low)[k % 2])


def block(scene: Scene, low: FloatArray, high: FloatArray, paint: dict[str, Paint]) -> None:
    """A solid between two corners of the floor ``(2,)``, up to the ceiling; a paint for each of its sides "frbl"."""
    centre, size = 0.5 * (low + high), high - low
    tall = float(scene.high_w[2])
    scene.box(Place(0.0, 0.0, 0.0), (*centre, tall / 2), (*size, tall), paint["f"], "wall", faces="frbl", special=paint)


def raise_wall(scene: Scene, rng: Rng, wall: Wall, kinds: tuple[str, ...]) -> None:
    """Build a wall; ``kinds`` are the materials to choose from."""
    first = Place(wall.low, wall.at, 0.0) if wall.axis else Place(wall.at, wall.low, np.pi / 2)
    height = float(scene.high_w[2])
    paint = {face: random_paint(rng, kinds) for face in "fb"}
    reached = 0.0
    for opening in wall.openings:
        low, high = opening.at_m - opening.width_m / 2, opening.at_m + opening.width_m / 2
        _part(scene, first, (reached, low), (0.0, height), paint)
        if opening.height_m < height:
            _part(scene, first, (low, high), (opening.height_m, height), paint)
            build(scene, first, rng, "frame", at=opening.at_m, wide=opening.width_m, height=opening.height_m)
        if opening.leaf_rad is not None:
            hinge = first.at(low, 0.0, yaw_rad=opening.leaf_rad)
            build(scene, hinge, rng, "leaf", wide=opening.width_m, height=opening.height_m)
        reached = high
    _part(scene, first, (reached, wall.high - wall.low), (0.0, height), paint)


def _part(scene: Scene, first: Place, x: tuple[float, float], z: tuple[float, float], paint: dict[str, Paint]) -> None:
    """A part of a wall, painted all round."""
    size = (x[1] - x[0], THICK_M, z[1] - z[0])
    if size[0] < 1e-3 or size[2] < 1e-3:
        return
    centre = (0.5 * (x[0] + x[1]), 0.0, 0.5 * (z[0] + z[1]))
    scene.box(first, centre, size, paint["f"], "wall", faces="frblu" if z[0] > 0 else "frbl", special=paint)
