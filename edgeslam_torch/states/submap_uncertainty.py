"""How well it is known where a piece of map lies that was begun where the camera had been carried to without a map.

Poses of different pieces are unrelated as far as images go. The drone's sensors, or constant velocity, relate them: by
the predicted pose with which a piece begins, in the unit that its depths were guessed in. What that leaves open stays
until both pieces are found to be one.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.atlas.submap_scale import is_other
from edgeslam_torch.types import FloatArray, ScaleEstimate


@dataclass(frozen=True, slots=True)
class _Begun:
    centre: FloatArray
    """``(3,)`` of the camera [map units]."""
    sigma_t: float
    """Standard deviation of it per axis [map units], that of the piece before included."""
    sigma_r_rad: float


@dataclass(slots=True)
class Apart:
    """What is known of the pieces that began after the flight's first one, by their numbers."""

    begun: dict[int, _Begun] = field(default_factory=dict)
    unit: ScaleEstimate = field(default_factory=ScaleEstimate)
    """Metres per map unit, as they were told when the camera left the first piece."""

    def other_unit(self, piece: int, told: ScaleEstimate) -> tuple[float, float] | None:
        """By how much what is told now of a later piece's unit surely differs from the first one's, and the standard
        deviation of the logarithm of that; None where it does not, or nobody knows."""
        if piece not in self.begun or not (math.isfinite(told.sigma) and math.isfinite(self.unit.sigma)):
            return None
        sigma = math.hypot(told.sigma / told.value, self.unit.sigma / self.unit.value)
        ratio = told.value / self.unit.value
        return (ratio, sigma) if is_other(ratio, sigma) else None

    def begin(self, piece: int, before: int, centre: FloatArray, sigma_t: float, sigma_r_rad: float) -> None:
        """A piece begins at a predicted pose.

        Args:
            piece: Its number.
            before: Number of the piece that the prediction starts from.
            centre: Camera ``(3,)`` [map units].
            sigma_t: Standard deviation of the prediction's translation per axis [map units].
            sigma_r_rad: The same of its rotation.
        """
        earlier = self.begun.get(before)
        if earlier is not None:
            sigma_t = math.hypot(sigma_t, self.sigma(before, centre, 0.0))
            sigma_r_rad = math.hypot(sigma_r_rad, earlier.sigma_r_rad)
        self.begun[piece] = _Begun(np.array(centre, dtype=np.float64), sigma_t, sigma_r_rad)

    def turned(self, piece: int, sigma_r_rad: float) -> None:
        """A piece was turned about where it began, as sure as that is."""
        if piece in self.begun:
            self.begun[piece] = replace(self.begun[piece], sigma_r_rad=sigma_r_rad)

    def moved(self, piece: int, grown: float) -> None:
        """A piece was moved to another, and is larger by a factor."""
        if piece not in self.begun and math.isfinite(self.unit.sigma):
            self.unit = replace(self.unit, value=self.unit.value / grown, sigma=self.unit.sigma / grown)

    def carried_sigma(self, piece: int) -> float:
        """Standard deviation per axis [map units] of where a piece began; infinite unless the drone's sensors carried
        the camera there."""
        begun = self.begun.get(piece)
        return math.inf if begun is None else begun.sigma_t

    def sigma(self, piece: int, centre: FloatArray, sigma_scale: float) -> float:
        """Standard deviation per axis [map units] of a camera of a piece in the world of the first one; infinite for
        one that nothing relates to it, as that of an earlier flight.

        Args:
            piece: Number of the piece as the map is now: pieces that were joined have the lower of their numbers.
            centre: The camera ``(3,)`` [map units].
            sigma_scale: Relative standard deviation of a piece's unit.

        Example:
            >>> apart = Apart()
            >>> apart.begin(1, 0, np.zeros(3), 0.1, 0.02)
            >>> round(apart.sigma(1, np.array([3.0, 0, 0]), 0.0), 3)
            0.117
        """
        begun = self.begun.get(piece)
        if begun is None:
            return math.inf
        way = float(np.linalg.norm(centre - begun.centre))
        if way == 0.0:
            return begun.sigma_t
        # Both pieces have a unit of their own.
        return math.hypot(begun.sigma_t, way * begun.sigma_r_rad, way * math.sqrt(2.0) * sigma_scale)
