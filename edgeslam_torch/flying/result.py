"""Result of a flight command, and the error of a refused one."""

from dataclasses import dataclass

from edgeslam_torch.errors import EdgeSlamError


class FlightRefused(EdgeSlamError):
    """A flight command is invalid or not possible now; nothing moved."""


@dataclass(frozen=True, slots=True)
class FlightResult:
    """How a flight command ended, by the drone's own map and pose, not by ground truth."""

    reached: bool
    reason: str
    """Explanation in words."""
    min_clearance_m: float
    """Minimum distance between hull and mapped obstacles [m]; NaN without obstacles."""
    path_m: float
    """Horizontal path length by the estimated pose [m]."""
