r"""Metric scale from the depth network, with its uncertainty.

Each keyframe gives the median of log (network depth [m] / map depth [map units]) over its triangulated anchors. All
keyframes of a scene share the network's error, so averaging their ratios does not reduce it. It is predicted from the
keyframes: from the slope :math:`b` of log network depth on log map depth inside a keyframe (1: the network follows
depth; 0: it predicts a constant), the spread :math:`s` of single anchors around their keyframe's ratio, and the
variation :math:`w` of the ratios between keyframes:

.. math:: \sigma^2 = \sigma_0^2 + a_b^2 (1 - b)^2 + a_s^2 s^2 + a_w^2 w^2

The coefficients are fitted to the true errors over recordings, simulated flights and degraded images of both
(docs/decisions/21-depth-sigma.md). Above a maximum of the sum the network is out of its domain.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.scale.belief import ScaleBelief
from edgeslam_torch.geometry.robust_statistics import median, robust_sigma
from edgeslam_torch.types import FloatArray

SLOPE_SIGMA = 0.4
SPREAD_SIGMA = 2.0
WANDER_SIGMA = 1.0
"""Log error of the scale per unit of missing slope, of spread and of variation between keyframes."""

MOST_SIGMA = 0.5
"""Maximum sigma of a usable scale: at two sigmas, a factor of e each way."""

_MAP_NOISE_LOG = 0.05
"""Log error of triangulated depth: regularises the slope towards 0 in scenes of uniform depth."""
_PRIOR_WANDER_LOG = 0.15
_PRIOR_COUNT = 4
"""Prior variation for few keyframes: the calibration's median, weighted as this many keyframes."""
_KEPT = 200
"""Maximum number of ratios stored, at least the map's number of keyframes."""
_LEAST_ANCHORS = 8
_LEAST_SPREAD_LOG = 0.02
"""Minimum number of anchors of a ratio, whose median then has a third of their spread as its sigma; and lower bound of
that spread, below that of any depth network."""


@dataclass(frozen=True, slots=True)
class DepthRatio:
    """Ratio of network depth to map depth over one keyframe's anchors."""

    log_ratio: float
    """Median of log (network depth [m] / map depth [map units])."""
    spread_log: float
    """Robust standard deviation of single anchors around it."""
    slope: float = 1.0
    """Of log network depth on log map depth."""
    depth_spread_log: float = 0.3
    """Standard deviation of the anchors' log depth: near zero the slope is noise."""
    points: int = 100

    @property
    def usable(self) -> bool:
        """Whether all values are finite and the spread is positive."""
        numbers = (self.log_ratio, self.spread_log, self.slope, self.depth_spread_log)
        return all(map(math.isfinite, numbers)) and self.spread_log > 0 and self.points > 0


def compared(network_m: FloatArray, map_depth: FloatArray) -> DepthRatio | None:
    """Ratio, spread and slope between network and triangulated z-depth of one keyframe's anchors.

    Args:
        network_m: Network depth at the anchors ``(A,)`` [m], NaN where it is undefined.
        map_depth: Their depth in the map ``(A,)`` [map units].

    Returns:
        ``None`` with fewer than eight usable anchors.
    """
    usable = np.isfinite(network_m) & (network_m > 0) & (map_depth > 0)
    if usable.sum() < _LEAST_ANCHORS:
        return None
    x, y = np.log(map_depth[usable]), np.log(network_m[usable])
    spread = max(_robust_deviation(y - x), _LEAST_SPREAD_LOG)
    slope, depth_spread = _slope(x, y)
    return DepthRatio(median(y - x), spread, slope, depth_spread, len(x))


def _slope(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Huber regression slope of ``y`` on ``x``, both ``(A,)``, and the weighted standard deviation of ``x``."""
    weight, slope, power = np.ones(len(x)), 0.0, 0.0
    for _ in range(10):
        share = weight / weight.sum()
        u, v = x - share @ x, y - share @ y
        power = float(share @ u**2)
        slope = float(share @ (u * v)) / max(power, 1e-12)
        left = v - slope * u
        weight = np.minimum(1.0, 1.5 * (_robust_deviation(left) + 1e-9) / np.maximum(np.abs(left), 1e-12))
    return slope, math.sqrt(power)


@dataclass(frozen=True, slots=True)
class DepthScale:
    """The network's estimate of a map's scale, with the components of its sigma."""

    log_scale: float
    """Log of metres per map unit."""
    sigma: float
    """Of ``log_scale``."""
    slope: float
    spread_log: float
    wander_log: float

    @property
    def in_domain(self) -> bool:
        """Whether the network is accurate enough in such scenes to determine the scale."""
        return self.sigma <= MOST_SIGMA

    @property
    def belief(self) -> ScaleBelief:
        """The estimate, to be decided on beside those of other sources."""
        return ScaleBelief(self.log_scale, self.sigma, "depth")

    def statistics(self) -> dict[str, float]:
        """For the report."""
        value = math.exp(self.log_scale)
        return {
            "scale depth": value,
            "scale depth sigma": value * self.sigma,
            "depth network slope": self.slope,
            "depth network spread": self.spread_log,
            "depth network wander": self.wander_log,
        }

    def warning(self) -> str | None:
        """Warning for the user; None inside the domain."""
        if self.in_domain:
            return None
        return (
            f"the depth network is out of its domain here: inside pictures its depth follows the map's with slope "
            f"{self.slope:.2f} (1 is right) and spreads by {100 * self.spread_log:.0f} %, from picture to picture its "
            f"scale wanders by {100 * self.wander_log:.0f} %; its metres may be wrong by a factor of "
            f"{math.exp(2.0 * self.sigma):.1f} and are not used. Metres need telemetry, a network trained on such "
            "scenes (--depth), or 'edgeslam finetune' on recordings like this one"
        )


class DepthRatios:
    """The ratios of a map's keyframes.

    Args:
        least_sigma: Log error of the scale that the statistics of the keyframes do not reveal.
    """

    def __init__(self, least_sigma: float) -> None:
        self._least_sigma = least_sigma
        self._ratios: list[DepthRatio] = []
        self._scale: DepthScale | None = None

    def add(self, ratio: DepthRatio) -> None:
        """Add one keyframe's ratio; non-finite ones are ignored."""
        if ratio.usable:
            self._ratios.append(ratio)
            del self._ratios[:-_KEPT]
            self._scale = None

    def scale(self) -> DepthScale | None:
        """The estimate of all keyframes; cached per keyframe."""
        if self._scale is None and self._ratios:
            self._scale = self._summed_up()
        return self._scale

    def _summed_up(self) -> DepthScale:
        table = [(r.log_ratio, r.spread_log, r.slope, r.depth_spread_log, r.points) for r in self._ratios]
        ratio, spread, slope, depth_spread, points = np.array(table).T
        mean, statistical = _robust_mean(ratio, spread)
        weight = points * depth_spread**2
        pooled = float(np.sum(weight * slope) / np.sum(weight + points * _MAP_NOISE_LOG**2))
        typical = float(np.median(spread))
        seen = _PRIOR_COUNT * _PRIOR_WANDER_LOG**2 + len(ratio) * _robust_deviation(ratio) ** 2
        wander = math.sqrt(seen / (_PRIOR_COUNT + len(ratio)))
        doubts = (SLOPE_SIGMA * (1.0 - pooled), SPREAD_SIGMA * typical, WANDER_SIGMA * wander)
        return DepthScale(mean, math.hypot(self._least_sigma, statistical, *doubts), pooled, typical, wander)


def _robust_mean(x: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Huber mean of ``(N,)`` and its standard deviation for independent errors."""
    centre = float(np.median(x))
    spread = np.hypot(sigma, _robust_deviation(x) + 1e-6)
    for _ in range(5):
        weight = np.minimum(1.0, 1.5 * spread / np.maximum(np.abs(x - centre), 1e-12)) / spread**2
        centre = float(np.sum(weight * x) / np.sum(weight))
    return centre, 1.0 / math.sqrt(float(np.sum(weight)))


def _robust_deviation(x: FloatArray) -> float:
    return robust_sigma(x - median(x))
