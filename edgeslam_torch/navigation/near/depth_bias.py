"""The usual metre of a depth network: what its depth has to be multiplied by, as many pictures agree.

A network that was trained elsewhere is wrong by tens of percent, but by much the same in every picture of a flight. So
this says what a picture without points of the map, or beyond them, shows; and it tells points whose unit was lost in a
turn on the spot.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.near.depth import ALONE_SIGMA, NearFit

_KEPT, _LEAST = 150, 15
"""Pictures: half a minute at five a second; fewer than three seconds tell nothing."""
_SPREAD = 0.15
"""Standard deviation of a picture's ratio from the usual one: .12 and .13 in two flights, logarithm."""
_WIDE_LOG = 0.35
"""Standard deviation of depth among points that tell a slope: from 1 to 3 m."""
_SIGMAS = 3.0
_DOUBTED = 5
"""Pictures on end, a second, that make it doubtful that a metre is one."""


@dataclass(slots=True)
class DepthBias:
    """Remembers what the points of the last pictures said."""

    _ratios: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """Picture by picture: logarithm of the network's depth of its points, and of metres for a metre of the network
    there, in the median."""
    _slopes: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """Of the lines of wide pictures."""
    _outliers: int = 0
    """Pictures on end that say something else."""
    _off_log: float = 0.0
    """By how much the last of them does."""

    @property
    def doubt(self) -> float:
        """By how much, relatively, a metre is off as pictures on end say; 0 where they say what is usual."""
        return abs(float(np.expm1(self._off_log))) if self._outliers >= _DOUBTED else 0.0

    def is_consistent(self, fit: NearFit, unit_m: float, sure: bool) -> bool:
        """Whether what a picture's points say is not far from what they usually say; remembered if metres are sure.

        Args:
            fit: To these points.
            unit_m: Metres for a unit of the map.
            sure: Whether these are known well.
        """
        middle_log, ratio_log = float(np.median(fit.network_log)), fit.ratio_log + float(np.log(unit_m))
        off_log = ratio_log - self._expected(middle_log) if self._is_ready() else 0.0
        if abs(off_log) > _SIGMAS * _SPREAD:
            self._outliers, self._off_log = self._outliers + 1, off_log
            if self._outliers > _KEPT // 2:  # so long is no turn: what was usual rested on other metres
                self._ratios.clear()
                self._outliers = 0
            return False
        self._outliers = 0
        if sure:
            self._ratios.append((middle_log, ratio_log))
            if float(np.std(fit.network_log)) > _WIDE_LOG:
                self._slopes.append(fit.slope)
        return True

    def line(self, unit_m: float) -> NearFit | None:
        """The usual line, of no picture's points; None before there is one."""
        if not self._is_ready():
            return None
        return NearFit(self._expected(0.0) - float(np.log(unit_m)), self._slope(), ALONE_SIGMA, 0)

    def _is_ready(self) -> bool:
        return len(self._ratios) >= _LEAST

    def _slope(self) -> float:
        return float(np.median(self._slopes)) if len(self._slopes) >= _LEAST else 1.0

    def _expected(self, network_log: float) -> float:
        """Logarithm of metres for a metre of the network at a depth."""
        middle, ratio = np.array(self._ratios).T
        return float(np.median(ratio + (self._slope() - 1.0) * (network_log - middle)))
