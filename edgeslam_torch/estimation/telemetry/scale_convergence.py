"""Convergence of the map's scale: recent changes by refinement predict further ones.

In its first seconds a map has few keyframes, and each refinement may rescale all of it, most with few features. A scale
fitted then is soon outdated. The indicator is the change in size of the stored path within the last second.
"""

import math

import numpy as np

from edgeslam_torch.estimation.telemetry.visual_memory import Sightings
from edgeslam_torch.types import FloatArray

_MEMORY_S = 1.0
"""Decay time of a change: after it a window's keyframes have been replaced."""
_WINDOW_S = 5.0
"""Maximum age of poses that constrain the present scale."""
_TO_COME = 1.3
"""Expected further change of the scale over its change within the last second (RMS)."""
_LEAST_POSES = 5
_LEAST_SIZE = 10.0
"""Minimum size of the path in standard deviations of a pose; below, its change is noise."""


class ScaleConvergence:
    """Change of the map's scale by refinement, leaky over `_MEMORY_S`."""

    def __init__(self) -> None:
        self._sum = self._most = 0.0
        self._at_s = -math.inf
        """Stamp of the last comparison."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the expected further change of the log scale."""
        return _TO_COME * self._most

    def compare(self, before: Sightings, after: Sightings, now_s: float) -> None:
        """Update with a refinement.

        Args:
            before: Stored poses before it.
            after: The same poses refined.
            now_s: Stamp of the newest frame. Frames since the last comparison are ignored: their tracked poses change
                independently of the map.
        """
        settled = (before.stamps_s <= self._at_s) & (before.stamps_s > self._at_s - _WINDOW_S)
        kept = math.exp(-max(0.0, now_s - self._at_s) / _MEMORY_S) if math.isfinite(self._at_s) else 0.0
        self._at_s = now_s
        self._sum *= kept
        if settled.sum() >= _LEAST_POSES:
            sizes = [_size(s.T[settled, :3, 3]) for s in (before, after)]
            if min(sizes) > _LEAST_SIZE * float(np.median(before.sigma_t[settled])):
                self._sum += math.log(sizes[1] / sizes[0])
        self._most = max(abs(self._sum), kept * self._most)


def _size(p: FloatArray) -> float:
    """RMS distance of points ``(N, 3)`` from their mean."""
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
