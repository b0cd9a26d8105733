"""Tasks that a flight has beside those of `navigation.tasks`: to stay where it is, and to go back the way it came."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.sight import Sight
from edgeslam_torch.types import FloatArray

HOME_M = 0.15
"""Distance from the take-off at which the drone is home."""
_SLOW_M_S = 0.15


@dataclass(frozen=True, slots=True)
class Stay:
    """Rise, look around, and hover."""

    def goals(self, layer: Layer, sight: Sight) -> np.ndarray:
        """Where it is."""
        return layer.cells(sight.p_w[:2])[None]

    def done(self, sight: Sight) -> bool:
        """At once: a pilot asks only when it is at its height."""
        return True

    def carry(self, moved: Moved) -> None:
        """It remembers nothing."""


@dataclass(slots=True)
class WayHome:
    """Fly to the take-off, along the way that was flown as long as the take-off lies beyond the grid."""

    track_w: FloatArray
    """``(N, 2)`` where it flew, oldest first [m]."""

    def goals(self, layer: Layer, sight: Sight) -> np.ndarray:
        """The cell of the oldest point of the way that the grid still holds."""
        points = np.concatenate([np.zeros((1, 2)), self.track_w])
        at = (points - layer.corner_w) / layer.cell_m
        held = ((at >= 1) & (at < np.array(layer.free.shape) - 1)).all(1)
        oldest = points[int(np.argmax(held))] if held.any() else sight.p_w[:2]
        return layer.cells(oldest)[None]

    def done(self, sight: Sight) -> bool:
        """Whether the drone is above its take-off, and slow."""
        near = float(np.linalg.norm(sight.p_w[:2])) < HOME_M
        return near and float(np.linalg.norm(sight.velocity_w)) < _SLOW_M_S

    def carry(self, moved: Moved) -> None:
        """Take the way along with the map; the take-off stays the origin."""
        self.track_w = moved.points(self.track_w)
