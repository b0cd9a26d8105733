"""The estimated vertical."""

from dataclasses import dataclass

from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class Up:
    """Vertical of a world frame with its uncertainty."""

    direction: FloatArray
    """``(3,)`` unit vector."""
    sigma_rad: float
    """Standard deviation of its angle."""
    source: str
    """Evidence: ``telemetry``, ``accelerometer``, ``edges``, or several with ``+``."""
