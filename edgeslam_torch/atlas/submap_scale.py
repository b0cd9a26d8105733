"""Correction of a submap's scale to that of the flight's first one by the drone's sensors.

A submap begins with predicted depths. In a corridor without texture its scale may be wrong by half, and images cannot
correct it before both submaps show a common place.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import sim3
from edgeslam_torch.types import FloatArray

AGAIN_S = 2.0
"""Time from one comparison to the next."""
SURE_LOG = 0.1
"""Maximum standard deviation of the log ratio of two scales for a correction."""
SIGMAS = 2.0


@dataclass(frozen=True, slots=True)
class Rescaled:
    """A submap that was scaled to another."""

    stamp_s: float
    piece: int
    S: FloatArray
    """``(4, 4)`` similarity that moved it: a scaling about its start."""
    sigma_log: float

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Change of scale at a keyframe of a submap."""
        return sim3.scale_of(self.S) if self.piece == piece else 1.0

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        scale = sim3.scale_of(self.S)
        return f"piece {self.piece} scaled by {scale:.3f} (sigma {100 * self.sigma_log:.1f} %) to the previous metres"


def about(centre: FloatArray, scale: float) -> FloatArray:
    """Similarity ``(4, 4)`` that scales about a point ``(3,)``.

    Example:
        >>> about(np.array([1.0, 0.0, 0.0]), 2.0)[0].tolist()
        [2.0, 0.0, 0.0, -1.0]
    """
    return sim3.compose(scale, np.eye(3), (1.0 - scale) * centre)


def is_other(ratio: float, sigma_log: float) -> bool:
    """Whether a ratio of two scales differs significantly from 1.

    Example:
        >>> is_other(1.25, 0.05), is_other(1.25, 0.12), is_other(0.95, 0.05)
        (True, False, False)
    """
    return sigma_log <= SURE_LOG and abs(float(np.log(ratio))) > SIGMAS * sigma_log
