"""Resampling of the layer onto a grid aligned with a wall."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.types import FloatArray

CELL_SIGMAS = 1.0 / math.sqrt(6.0)
"""Standard deviation of a width between two cells [cells]: both ends are uniform within their cells."""
REACH_M = 6.0
"""Half side of the grid; beyond it depth does not resolve a wall."""
_STEP_RAD = math.radians(3.0)
_DISTINCT_RAD = math.radians(12.0)
"""Minimum angle between distinct wall directions."""
_DIRECTIONS = 2
"""Number of directions; each also yields its perpendicular, since a corridor's end wall is too short to be detected."""


@dataclass(frozen=True, slots=True)
class Walls:
    """A layer and its upright occupied cells: walls, not tables."""

    layer: Layer
    upright: np.ndarray
    """``(X, Y)`` bool."""


@dataclass(frozen=True)
class WallGrid:
    """Square grid around a point, indexed ``[t, s]``: s along the direction, t to its left."""

    free: np.ndarray
    solid: np.ndarray
    upright: np.ndarray
    centre_w: FloatArray
    """``(2,)`` centre of the square [m]."""
    along_w: FloatArray
    """``(2,)`` unit vector of s."""
    cell_m: float

    @property
    def left_w(self) -> FloatArray:
        """``(2,)`` unit vector of t."""
        return np.array([-self.along_w[1], self.along_w[0]])

    @cached_property
    def wall(self) -> np.ndarray:
        """``(N, N)`` bool: upright cells, dilated by one row."""
        rows = np.pad(self.upright, ((1, 1), (0, 0)))
        return np.asarray(rows[:-2] | rows[1:-1] | rows[2:])

    def at(self, s: float, t: float) -> FloatArray:
        """World point ``(2,)`` at fractional cell coordinates."""
        half = 0.5 * (self.free.shape[0] - 1)
        offset = ((s - half) * self.along_w + (t - half) * self.left_w) * self.cell_m
        return np.asarray(self.centre_w + offset)


def wall_grid(walls: Walls, centre_w: FloatArray, angle_rad: float) -> WallGrid:
    """Grid around a point ``(2,)`` along a direction; cells outside the layer are unknown."""
    layer = walls.layer
    along = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    steps = np.arange(-round(REACH_M / layer.cell_m), round(REACH_M / layer.cell_m) + 1) * layer.cell_m
    t, s = np.meshgrid(steps, steps, indexing="ij")
    p = centre_w + s[..., None] * along + t[..., None] * np.array([-along[1], along[0]])
    index = np.floor((p - layer.corner_w) / layer.cell_m).astype(int)
    inside = ((index >= 0) & (index < layer.free.shape)).all(-1)
    i, j = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
    free, solid, upright = (mask[i, j] & inside for mask in (layer.free, layer.solid, walls.upright))
    return WallGrid(free, solid, upright, np.asarray(centre_w, dtype=np.float64), along, layer.cell_m)


def along_walls(walls: Walls, centre_w: FloatArray) -> list[WallGrid]:
    """Grids around a point ``(2,)``, one per wall direction."""
    return [wall_grid(walls, centre_w, angle) for angle in wall_directions(walls, centre_w)]


def wall_directions(walls: Walls, centre_w: FloatArray) -> list[float]:
    """Wall directions in [0, pi), the strongest first, each followed by its perpendicular; empty without walls."""
    layer = walls.layer
    p = layer.centres(np.argwhere(walls.upright)) - centre_w
    p = p[np.abs(p).max(axis=1) < REACH_M] if len(p) else p
    if len(p) < 5:
        return []
    angles = np.arange(0.0, math.pi - 1e-9, _STEP_RAD)
    # Score of a direction: sum of squared histogram counts across it.
    across = p[:, 1, None] * np.cos(angles) - p[:, 0, None] * np.sin(angles)
    rows = np.floor(across / layer.cell_m).astype(int)
    rows -= rows.min()
    width = int(rows.max()) + 1
    counts = np.zeros((len(angles), width))
    np.add.at(counts, (np.broadcast_to(np.arange(len(angles)), rows.shape), rows), 1.0)
    score = (counts**2).sum(1)
    found: list[float] = []
    for k in np.argsort(-score):
        if score[k] < 0.25 * score.max() or len(found) == 2 * _DIRECTIONS:
            break
        off = [abs((angles[k] - other + math.pi / 4) % (math.pi / 2) - math.pi / 4) for other in found]
        if all(a > _DISTINCT_RAD for a in off):
            found += [float(angles[k]), float((angles[k] + math.pi / 2) % math.pi)]
    return found


def runs(mask: np.ndarray) -> np.ndarray:
    """Runs of a mask ``(N,)``: ``(R, 2)`` first index and one past the last.

    Example:
        >>> runs(np.array([True, True, False, True])).tolist()
        [[0, 2], [3, 4]]
    """
    edge = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edge.reshape(-1, 2)
