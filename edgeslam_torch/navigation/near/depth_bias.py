"""Bias of a depth network, estimated over many frames of a flight.

Outside its training domain a network is biased by tens of percent, but consistently within a flight. The estimate
scales frames without map points, and those whose points are at a wrong scale, such as after a turn on the spot.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.near.depth import ALONE_SIGMA, NearFit

_KEPT, _LEAST = 150, 15
"""Frames used: half a minute at 5 Hz, at least three seconds."""
_SPREAD = 0.15
"""Standard deviation of a frame's log ratio around the bias (measured: 0.12 to 0.13)."""
_WIDE_LOG = 0.35
"""Minimum standard deviation of log depth among points to estimate a slope: depths of 1 to 3 m."""
_SIGMAS = 3.0


@dataclass(slots=True)
class DepthBias:
    """Running estimate of the network's bias from the map points of recent frames."""

    _ratios: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """Per frame, medians over its points: log network depth, and log metres per network metre."""
    _slopes: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """Slopes of frames with a wide depth range."""
    _outliers: int = 0
    """Consecutive outlier frames."""

    def is_consistent(self, fit: NearFit, unit_m: float, sure: bool) -> bool:
        """Whether a frame's fit agrees with the bias; added to the estimate if the scale is certain.

        Args:
            fit: Line fit to the frame's points.
            unit_m: Metres per map unit.
            sure: Whether ``unit_m`` is certain.
        """
        middle_log, ratio_log = float(np.median(fit.network_log)), fit.ratio_log + float(np.log(unit_m))
        off_log = ratio_log - self._expected(middle_log) if self._is_ready() else 0.0
        if abs(off_log) > _SIGMAS * _SPREAD:
            self._outliers += 1
            if self._outliers > _KEPT // 2:  # the bias itself was estimated at another scale
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
        """The bias as a line without points; None before it is known."""
        if not self._is_ready():
            return None
        return NearFit(self._expected(0.0) - float(np.log(unit_m)), self._slope(), ALONE_SIGMA, 0)

    def _is_ready(self) -> bool:
        return len(self._ratios) >= _LEAST

    def _slope(self) -> float:
        return float(np.median(self._slopes)) if len(self._slopes) >= _LEAST else 1.0

    def _expected(self, network_log: float) -> float:
        """Log metres per network metre at a log network depth."""
        middle, ratio = np.array(self._ratios).T
        return float(np.median(ratio + (self._slope() - 1.0) * (network_log - middle)))
