"""Uncertainty of a submap that was started at a predicted pose, relative to the first one.

Images do not relate submaps until they are merged. Until then the predicted pose at which a submap starts relates them,
if the drone's sensors predicted it; its depths are in a scale of their own.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.atlas.submap_scale import is_other
from edgeslam_torch.types import FloatArray, ScaleEstimate


@dataclass(frozen=True, slots=True)
class _Begun:
    centre: FloatArray
    """``(3,)`` camera centre [map units]."""
    sigma_t: float
    """Standard deviation of the centre per axis [map units], including that of the previous submap."""
    sigma_r_rad: float


@dataclass(slots=True)
class SubmapUncertainty:
    """Uncertainty of the submaps after the first one, by their numbers."""

    starts: dict[int, _Begun] = field(default_factory=dict)
    unit: ScaleEstimate = field(default_factory=ScaleEstimate)
    """Metres per map unit of the first submap, as estimated when the camera left it."""

    def scale_ratio(self, piece: int, scale: ScaleEstimate) -> tuple[float, float] | None:
        """Ratio of a later submap's scale to that of the first one and the standard deviation of its logarithm; None
        where the ratio is not significant or unknown."""
        if piece not in self.starts or not (math.isfinite(scale.sigma) and math.isfinite(self.unit.sigma)):
            return None
        sigma = math.hypot(scale.sigma / scale.value, self.unit.sigma / self.unit.value)
        ratio = scale.value / self.unit.value
        return (ratio, sigma) if is_other(ratio, sigma) else None

    def begin(self, piece: int, before: int, centre: FloatArray, sigma_t: float, sigma_r_rad: float) -> None:
        """Add a submap that starts at a predicted pose.

        Args:
            piece: Its number.
            before: Number of the piece that the prediction starts from.
            centre: Camera ``(3,)`` [map units].
            sigma_t: Standard deviation of the prediction's translation per axis [map units].
            sigma_r_rad: The same of its rotation.
        """
        earlier = self.starts.get(before)
        if earlier is not None:
            sigma_t = math.hypot(sigma_t, self.sigma(before, centre, 0.0))
            sigma_r_rad = math.hypot(sigma_r_rad, earlier.sigma_r_rad)
        self.starts[piece] = _Begun(np.array(centre, dtype=np.float64), sigma_t, sigma_r_rad)

    def turned(self, piece: int, sigma_r_rad: float) -> None:
        """Replace the rotational uncertainty of a submap that was rotated about its start."""
        if piece in self.starts:
            self.starts[piece] = replace(self.starts[piece], sigma_r_rad=sigma_r_rad)

    def moved(self, piece: int, grown: float) -> None:
        """Update the first scale after a submap was merged into another and grew by a factor."""
        if piece not in self.starts and math.isfinite(self.unit.sigma):
            self.unit = replace(self.unit, value=self.unit.value / grown, sigma=self.unit.sigma / grown)

    def start_sigma(self, piece: int) -> float:
        """Standard deviation per axis [map units] of a submap's start; infinite unless sensors predicted it."""
        start = self.starts.get(piece)
        return math.inf if start is None else start.sigma_t

    def sigma(self, piece: int, centre: FloatArray, sigma_scale: float) -> float:
        """Standard deviation per axis [map units] of a camera of a submap in the world of the first one; infinite for
        an unrelated submap, as that of an earlier flight.

        Args:
            piece: Its present number: merged submaps have the lower of their numbers.
            centre: The camera ``(3,)`` [map units].
            sigma_scale: Relative standard deviation of a submap's scale.

        Example:
            >>> uncertainty = SubmapUncertainty()
            >>> uncertainty.begin(1, 0, np.zeros(3), 0.1, 0.02)
            >>> round(uncertainty.sigma(1, np.array([3.0, 0, 0]), 0.0), 3)
            0.117
        """
        start = self.starts.get(piece)
        if start is None:
            return math.inf
        way = float(np.linalg.norm(centre - start.centre))
        if way == 0.0:
            return start.sigma_t
        # Both submaps have a scale of their own.
        return math.hypot(start.sigma_t, way * start.sigma_r_rad, way * math.sqrt(2.0) * sigma_scale)
