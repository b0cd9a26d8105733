"""What a drone can hit: every surface that is painted, every solid, and glass that is not painted at all."""

from collections.abc import Sequence

import numpy as np

from edgeslam_torch.synthetic.house.world import Box, Boxes, Surfaces, World, in_parts
from edgeslam_torch.types import FloatArray


class Solids:
    """Surfaces and boxes of a world.

    Args:
        world: Its painted surfaces but the floor, on which drones stand; and its boxes.
        unseen: Solids without a painted face, such as panes of glass.
    """

    def __init__(self, world: World, unseen: Sequence[Box] = ()) -> None:
        self._surfaces = Surfaces([quad for quad in world.quads if quad.name != "floor"])
        self._boxes = Boxes([*world.boxes, *unseen])
        self._low, self._high = world.bounds_w

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest surface, ``(N,)``; 0 inside a solid or outside the world."""
        return in_parts(self._of, p_w)

    def _of(self, p: FloatArray) -> FloatArray:
        nearest = np.minimum(p[:, :2] - self._low[:2], self._high[:2] - p[:, :2]).min(1)
        nearest = np.maximum(np.minimum(nearest, self._high[2] - p[:, 2]), 0.0)
        return np.minimum(np.minimum(nearest, self._boxes.distance(p)), self._surfaces.distance(p))
