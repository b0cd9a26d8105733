"""What became of a verb of a flight, and what is not even begun."""

from dataclasses import dataclass

from edgeslam_torch.errors import EdgeSlamError


class FlightRefused(EdgeSlamError):
    """What was asked of a flight is wrong or not possible now; nothing moved for it."""


@dataclass(frozen=True, slots=True)
class FlightResult:
    """How a verb ended. The drone's own map and pose say so, not the truth."""

    reached: bool
    reason: str
    """In words; why not, or what is done."""
    min_clearance_m: float
    """Least distance of the drone's hull to what its map shows as solid [m]; NaN if it showed nothing."""
    path_m: float
    """Level way flown, by its own pose [m]."""
