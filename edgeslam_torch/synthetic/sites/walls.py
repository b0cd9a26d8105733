"""Walls with openings and doors between the parts of a site."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.synthetic.house.furniture import picture_paint
from edgeslam_torch.synthetic.house.scene import Paint, Place, Scene, random_paint
from edgeslam_torch.types import FloatArray

Rng = np.random.Generator
THICK_M = 0.12
DOOR_HEIGHT_M = 2.05
_FRAME_M = 0.06


@dataclass(frozen=True, slots=True)
class Opening:
    """A way through a wall, from the floor up."""

    at_m: float
    """Its middle, along the wall from the wall's first end."""
    width_m: float = 0.9
    height_m: float = DOOR_HEIGHT_M
    leaf_rad: float | None = None
    """A door leaf hung at its first side, opened by this angle; None for no leaf, 0 for a closed door."""

    @property
    def passable(self) -> bool:
        """Whether a drone can fly through."""
        return self.leaf_rad is None or self.leaf_rad > np.radians(75.0)


def wall(
    scene: Scene,
    rng: Rng,
    ends_w: FloatArray,
    openings: Sequence[Opening] = (),
    kinds: tuple[str, ...] = ("plaster",),
) -> None:
    """Build an upright wall between two points of the floor.

    Args:
        scene: What it is added to.
        rng: Of its paint.
        ends_w: ``(2, 2)`` first and second end of its middle line [m].
        openings: In order along the wall, without overlap.
        kinds: Materials to choose from.
    """
    along = ends_w[1] - ends_w[0]
    length, yaw = float(np.linalg.norm(along)), float(np.arctan2(along[1], along[0]))
    first = Place(float(ends_w[0, 0]), float(ends_w[0, 1]), yaw)
    height = float(scene.high_w[2])
    paint = {face: random_paint(rng, kinds) for face in "fb"}
    reached = 0.0
    for opening in openings:
        low, high = opening.at_m - opening.width_m / 2, opening.at_m + opening.width_m / 2
        _block(scene, first, (reached, low), (0.0, height), paint)
        _block(scene, first, (low, high), (opening.height_m, height), paint)
        _frame(scene, first, opening, random_paint(rng, ("veneer", "plaster", "metal")))
        if opening.leaf_rad is not None:
            _leaf(scene, first.at(low, 0.0), opening, picture_paint(rng, "door"))
        reached = high
    _block(scene, first, (reached, length), (0.0, height), paint)


def _block(scene: Scene, first: Place, x: tuple[float, float], z: tuple[float, float], paint: dict[str, Paint]) -> None:
    """A part of a wall, painted all round."""
    size = (x[1] - x[0], THICK_M, z[1] - z[0])
    if size[0] < 1e-3 or size[2] < 1e-3:
        return
    centre = (0.5 * (x[0] + x[1]), 0.0, 0.5 * (z[0] + z[1]))
    scene.box(first, centre, size, paint["f"], "wall", faces="frblu" if z[0] > 0 else "frbl", special=paint)


def _frame(scene: Scene, first: Place, opening: Opening, paint: Paint) -> None:
    """Door frame on both sides of the wall, around the opening."""
    deep = THICK_M + 0.04
    for side in (-1, 1):
        x = opening.at_m + side * (opening.width_m + _FRAME_M) / 2
        scene.box(first, (x, 0.0, opening.height_m / 2), (_FRAME_M, deep, opening.height_m), paint, "door frame",
                  faces="frbl", inside=True)  # fmt: skip
    lintel = (opening.width_m + 2 * _FRAME_M, deep, _FRAME_M)
    scene.box(first, (opening.at_m, 0.0, opening.height_m + _FRAME_M / 2), lintel, paint, "door frame",
              faces="frbltu", inside=True)  # fmt: skip


def _leaf(scene: Scene, hinge: Place, opening: Opening, paint: Paint) -> None:
    """A door's leaf, turned about its hinge towards the wall's front (+y)."""
    assert opening.leaf_rad is not None
    turned = hinge.at(0.0, 0.0, yaw_rad=opening.leaf_rad)
    edge = Paint("veneer", 0, paint.tint)
    scene.box(turned, (opening.width_m / 2, 0.0, opening.height_m / 2), (opening.width_m - 0.01, 0.04,
              opening.height_m - 0.01), edge, "door", faces="frblt", special={"f": paint, "b": paint})  # fmt: skip
