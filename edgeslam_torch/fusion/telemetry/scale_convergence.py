"""Whether a map still changes its scale: refinement that moves what was mapped before will move it again.

In its first seconds a map holds few keyframes, and each refinement may rescale all of it, most where there is little to
see. A scale told by then is right for the map as it was, and metres published with it are wrong a second later. It
shows in how much the remembered path has changed its size within the last second.
"""

import math

import numpy as np

from edgeslam_torch.fusion.telemetry.visual_memory import Sightings
from edgeslam_torch.types import FloatArray

_MEMORY_S = 1.0
"""Time in which a change is forgotten: a window's keyframes are older then."""
_WINDOW_S = 5.0
"""Age of poses beyond which they tell nothing of the present scale."""
_TO_COME = 1.3
"""How much more the scale changes, as a share of what it has changed within the last second (root mean square)."""
_LEAST_POSES = 5
_LEAST_SIZE = 10.0
"""Size of the path in standard deviations of a pose, below which its change is noise."""


class ScaleConvergence:
    """Change of the map's scale by refinement, leaky over `_MEMORY_S`."""

    def __init__(self) -> None:
        self._sum = self._most = 0.0
        self._at_s = -math.inf
        """Stamp of the last comparison."""

    @property
    def sigma(self) -> float:
        """Standard deviation of what the log scale may still change."""
        return _TO_COME * self._most

    def compare(self, before: Sightings, after: Sightings, now_s: float) -> None:
        """Take in a refinement.

        Args:
            before: Remembered poses as they were.
            after: The same poses refined.
            now_s: Stamp of the newest frame. Frames after the last comparison's are left out: their tracked poses
                change as well, which says nothing of the map.
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
    """Root mean square distance of points ``(N, 3)`` from their mean."""
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
