"""What a drone can hit: every surface that is painted, every solid, and glass that is not painted at all."""

from collections.abc import Sequence

import numpy as np

from edgeslam_torch.synthetic.house.world import Box, World
from edgeslam_torch.types import FloatArray

_CHUNK = 512
"""Points at a time: some megabytes."""


class Solids:
    """Surfaces and boxes of a world, arranged for quick questions about single points.

    Args:
        world: Its painted surfaces but the floor, on which drones stand; and its boxes.
        unseen: Solids without a painted face, such as panes of glass.
    """

    def __init__(self, world: World, unseen: Sequence[Box] = ()) -> None:
        quads = [quad for quad in world.quads if quad.name != "floor"]
        self._origin = np.array([q.origin_w for q in quads])
        self._basis = np.stack([np.array([q.u_w for q in quads]), np.array([q.v_w for q in quads])], axis=2)
        self._inverse = np.linalg.pinv(self._basis)
        boxes = [*world.boxes, *unseen]
        self._centre = np.array([b.centre_w for b in boxes]).reshape(-1, 3)
        self._half = np.array([b.half_m for b in boxes]).reshape(-1, 3)
        yaw = np.array([b.yaw_rad for b in boxes])
        self._cos, self._sin = np.cos(yaw), np.sin(yaw)
        self._low, self._high = world.bounds_w

    def distance(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(N, 3)`` to the nearest surface, ``(N,)``; 0 inside a solid or outside the world.

        Exact for rectangles; for slanted parallelograms (leaves) at most a few percent too far.
        """
        points = np.asarray(p_w, dtype=np.float64)
        chunks = [self._of(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)]
        return np.concatenate(chunks) if chunks else np.zeros(0)

    def _of(self, p: FloatArray) -> FloatArray:
        nearest = np.minimum(p[:, :2] - self._low[:2], self._high[:2] - p[:, :2]).min(1)
        nearest = np.maximum(np.minimum(nearest, self._high[2] - p[:, 2]), 0.0)
        if len(self._centre):
            offset = p[:, None] - self._centre  # (N, B, 3)
            x = self._cos * offset[..., 0] + self._sin * offset[..., 1]
            y = self._cos * offset[..., 1] - self._sin * offset[..., 0]
            out = [np.maximum(np.abs(v) - self._half[:, k], 0.0) for k, v in enumerate((x, y, offset[..., 2]))]
            nearest = np.minimum(nearest, np.sqrt((out[0] ** 2 + out[1] ** 2 + out[2] ** 2).min(1)))
        if len(self._origin):
            offset = p[:, None] - self._origin  # (N, Q, 3)
            s, t = (np.clip((offset * self._inverse[:, k]).sum(-1), 0.0, 1.0) for k in (0, 1))
            away = offset - s[..., None] * self._basis[..., 0] - t[..., None] * self._basis[..., 1]
            nearest = np.minimum(nearest, np.sqrt((away**2).sum(-1).min(1)))
        return nearest
