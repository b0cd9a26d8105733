"""Where up is: what an accelerometer feels, and what follows from all evidence."""

from dataclasses import dataclass

from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class SpecificForce:
    """What an accelerometer fixed to the camera felt: at rest it points up."""

    stamps_s: FloatArray
    """``(M,)`` in time order, on the images' clock [s]."""
    force_c: FloatArray
    """``(M, 3)`` in the camera's axes [m/s^2]."""
    sigma_rad: float
    """How far its mean over a recording is off the vertical: bias and mount."""


@dataclass(frozen=True, slots=True)
class Up:
    """Where up is in some world, and how well that is known."""

    direction: FloatArray
    """``(3,)`` unit vector."""
    sigma_rad: float
    """Standard deviation of its angle."""
    source: str
    """Evidence: ``telemetry``, ``accelerometer``, ``edges``, or several with ``+``."""
