"""Specific force of an accelerometer, and the estimated vertical."""

from dataclasses import dataclass

from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class SpecificForce:
    """Readings of an accelerometer fixed to the camera: at rest, specific force points up."""

    stamps_s: FloatArray
    """``(M,)`` in temporal order, on the images' clock [s]."""
    force_c: FloatArray
    """``(M, 3)`` in the camera's axes [m/s^2]."""
    sigma_rad: float
    """Standard deviation of the angle between its mean and the vertical: bias and mount."""


@dataclass(frozen=True, slots=True)
class Up:
    """Vertical of a world frame with its uncertainty."""

    direction: FloatArray
    """``(3,)`` unit vector."""
    sigma_rad: float
    """Standard deviation of its angle."""
    source: str
    """Evidence: ``telemetry``, ``accelerometer``, ``edges``, or several with ``+``."""
