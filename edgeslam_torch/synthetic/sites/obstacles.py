"""Things that stand and hang in the way, at every height, with a way left between them."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from edgeslam_torch.synthetic.house.pieces import build
from edgeslam_torch.synthetic.house.scene import Place, Scene
from edgeslam_torch.synthetic.house.world import in_parts, to_boxes

Rng = np.random.Generator
KINDS = ("column", "hanging_lamp", "table_and_chair", "pile", "lamp")
_GRID_M = 0.1
PASSAGE_M = 0.4
"""Kept free around at least one way from place to place: a drone of 20 cm with its uncertainty."""


def stand_in_the_way(
    scene: Scene,
    rng: Rng,
    low: tuple[float, float],
    high: tuple[float, float],
    count: int,
    kept: list[tuple[float, float]],
) -> None:
    """Add obstacles within a rectangle of the floor; those that would part the ``kept`` places are left out."""
    added = 0
    for _ in range(6 * count):
        if added == count:
            return
        x, y = (float(v) for v in rng.uniform(low, high))
        before = len(scene.quads), len(scene.boxes)
        kind = KINDS[int(rng.integers(len(KINDS)))]
        build(scene, Place(x, y, float(rng.uniform(-np.pi, np.pi))), rng, kind)
        if connected(scene, kept):
            added += 1
        else:
            del scene.quads[before[0] :], scene.boxes[before[1] :]


def connected(scene: Scene, places: Sequence[Sequence[float]]) -> bool:
    """Whether one can go between places ``(x, y)`` of the floor at heights of flight, `PASSAGE_M` from every solid, and
    down to the floor at the first of them."""
    low, high = scene.low_w[:2], scene.high_w[:2]
    to_solid = to_boxes([*scene.boxes, *scene.unseen])
    x, y = (low[k] + (np.arange(np.ceil((high - low)[k] / _GRID_M)) + 0.5) * _GRID_M for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    free = np.minimum(grid - low, high - grid).min(-1) > PASSAGE_M
    for z in (0.8, 1.1, 1.4):
        p = np.insert(grid, 2, z, axis=-1)
        free &= in_parts(to_solid, p.reshape(-1, 3)).reshape(free.shape) > PASSAGE_M
    parts, _ = ndimage.label(free)
    found = {int(parts[tuple(np.floor((np.array(p) - low) / _GRID_M).astype(int))]) for p in places}
    column = np.array([[*places[0], z] for z in np.arange(0.0, 1.0, 0.1)])
    return bool((to_solid(column) > PASSAGE_M).all()) and len(found) == 1 and 0 not in found
