"""Scale of a submap that began on predicted depths, relative to the map before it."""

import math
from dataclasses import dataclass, replace

from edgeslam_torch.estimation.scale.belief import ScaleBelief, contradict
from edgeslam_torch.noise import SUBMAP_SCALE_LOG

_SURE = 0.1
"""Relative sigma from which on the submap's scale counts as measured."""


@dataclass(frozen=True, slots=True)
class SubmapScale:
    """What sensors have measured since a submap began."""

    before: ScaleBelief
    """Metres per map unit when it began."""
    measured: ScaleBelief | None = None
    """Metres per unit of the submap."""

    @property
    def is_known(self) -> bool:
        """Whether it is measured."""
        return self.measured is not None and self.measured.sigma < _SURE

    @property
    def is_settled(self) -> bool:
        """Whether it is measured as accurately as the map's: then both are one."""
        return self.measured is not None and self.is_known and self.measured.sigma <= self.before.sigma

    @property
    def sigma(self) -> float:
        """Relative standard deviation of the submap's unit in the map's."""
        return self.measured.sigma if self.measured is not None and self.is_known else SUBMAP_SCALE_LOG

    @property
    def growth(self) -> float:
        """Factor by which the submap has to grow to be in the map's unit; 1 while both may be the same.

        Example:
            >>> before = ScaleBelief(0.0, 0.02, "telemetry")
            >>> SubmapScale(before, ScaleBelief(math.log(0.5), 0.05, "height")).growth
            0.5
            >>> SubmapScale(before, ScaleBelief(math.log(0.95), 0.05, "height")).growth
            1.0
        """
        if self.measured is None or not self.is_known:
            return 1.0
        if not (self.is_settled or contradict(self.measured, self.before)):
            return 1.0
        return math.exp(self.measured.log_scale - self.before.log_scale)

    def grown(self) -> "SubmapScale":
        """The same of the submap once it has grown by `growth`."""
        if self.measured is None:
            return self
        unit = self.measured.log_scale - math.log(self.growth)
        return replace(self, measured=replace(self.measured, log_scale=unit))
