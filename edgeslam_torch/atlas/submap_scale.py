"""A piece of map that has another unit than the flight's first one: the drone's sensors tell, and it is brought to it.

A piece begins with depths that were guessed. In a bare corridor they, and what is mapped on them, may be off by half,
and the images of two pieces that show nothing in common never tell.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import sim3
from edgeslam_torch.types import FloatArray

AGAIN_S = 2.0
"""Time from one comparison to the next."""
SURE_LOG = 0.1
"""Most standard deviation of the log ratio of two units by which a piece is scaled."""
SIGMAS = 2.0


@dataclass(frozen=True, slots=True)
class Rescaled:
    """A piece that was brought to the unit of another."""

    stamp_s: float
    piece: int
    S: FloatArray
    """``(4, 4)`` similarity that moved it: about where it began."""
    sigma_log: float

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Factor by which the map grew around a keyframe that belongs to a piece."""
        return sim3.scale_of(self.S) if self.piece == piece else 1.0

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        scale = sim3.scale_of(self.S)
        return f"piece {self.piece} scaled by {scale:.3f} (sigma {100 * self.sigma_log:.1f} %) to the metres before it"


def about(centre: FloatArray, scale: float) -> FloatArray:
    """The similarity ``(4, 4)`` that scales about a point ``(3,)``.

    Example:
        >>> about(np.array([1.0, 0.0, 0.0]), 2.0)[0].tolist()
        [2.0, 0.0, 0.0, -1.0]
    """
    return sim3.compose(scale, np.eye(3), (1.0 - scale) * centre)


def is_other(ratio: float, sigma_log: float) -> bool:
    """Whether a ratio of two units is surely not 1.

    Example:
        >>> is_other(1.25, 0.05), is_other(1.25, 0.12), is_other(0.95, 0.05)
        (True, False, False)
    """
    return sigma_log <= SURE_LOG and abs(float(np.log(ratio))) > SIGMAS * sigma_log
