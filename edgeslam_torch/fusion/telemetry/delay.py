"""Video delay behind telemetry, estimated from the common motion."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.telemetry.alignment import map_to_world, turns
from edgeslam_torch.fusion.telemetry.track import TelemetryTrack
from edgeslam_torch.fusion.telemetry.visual_memory import Displacements, VisualMemory
from edgeslam_torch.types import FloatArray

_MIN_DISPLACEMENTS = 8
"""Minimum number of displacements: found with so few, 1.2 stated sigmas off (rms of 32 cases, at most 2.7); with 6 some
were 6 sigmas off."""
GROWTH = 1.3
"""Growth of the data after which the search is repeated."""
_GUESS_S = 0.5
"""Initial value, in the middle of measured Tello delays (0.3 to 0.8 s)."""
_STEP_S = 0.05
_MARGIN_S = 0.1
"""Searched and used beyond the configured range, so that a delay at its end is found, and one beyond that is seen to be
outside by `comparison`, which steps by as much."""
_MOST_SIGMA_S = 0.05
_VALLEY_S = 0.15
_CLEARLY = 6.0
"""Log likelihood by which a second valley must be worse."""
_CLOCK_SIGMA_S = 0.005
_KEPT = 0.9
"""Share of the residuals used: one in ten may be an outlier."""


@dataclass(frozen=True, slots=True)
class Delay:
    """A frame stamped ``t`` shows what telemetry reported at ``t - value_s``."""

    value_s: float
    sigma_s: float
    """Infinite while it is a guess, 0 when configured."""


class DelaySearch:
    """Keeps the delay, and searches again as evidence grows."""

    def __init__(self, config: FusionConfig, R_b_c: FloatArray) -> None:
        self._config, self._R_b_c = config, R_b_c
        fixed = config.delay_s
        self.delay = Delay(_GUESS_S, math.inf) if fixed is None else Delay(fixed, 0.0)
        self._tried_at = 0

    def search(self, memory: VisualMemory, track: TelemetryTrack) -> None:
        """Delay at which visual and telemetry displacements and turns agree best; kept where none stands out."""
        n = memory.count
        if self._config.delay_s is not None or n < _MIN_DISPLACEMENTS or n < GROWTH * self._tried_at:
            return
        self._tried_at = n
        low, high = self._config.delay_range_s[0] - _MARGIN_S, self._config.delay_range_s[1] + _MARGIN_S
        moved = memory.displacements()
        common = track.covered(moved.from_s - high, moved.to_s - low)
        if common.sum() < _MIN_DISPLACEMENTS:
            return
        moved = moved.only(common)
        delays_s = np.arange(low, high + 1e-9, _STEP_S)
        cost = np.array([self._cost(d, moved, memory, track) for d in delays_s])
        found = _least(delays_s, cost)
        if found is not None:
            value_s = float(np.clip(found.value_s, low, high))
            self.delay = Delay(value_s, math.hypot(found.sigma_s, _CLOCK_SIGMA_S))

    def _cost(self, delay_s: float, moved: Displacements, memory: VisualMemory, track: TelemetryTrack) -> float:
        """Misfit of displacements (log-likelihood with the residual's own spread) and of rotations."""
        R_w_m = map_to_world(memory.sightings(), track, delay_s, self._R_b_c)
        if R_w_m is None:
            return math.inf
        moved = moved.on_telemetry_clock(delay_s)
        seen = moved.moved @ R_w_m.T
        told = track.displacement(moved.to_s) - track.displacement(moved.from_s)
        told, seen = told - told.mean(axis=0), seen - seen.mean(axis=0)
        scale = float(np.sum(told * seen) / max(float(np.sum(seen**2)), 1e-30))
        residual = told - max(scale, 0.0) * seen
        power = np.sort(np.sum(residual**2, axis=1))[: max(3, int(_KEPT * len(residual)))]
        sigma = self._config.sigma_velocity_m_s * math.sqrt(0.1 * self._config.interval_s)
        cost = 1.5 * len(residual) * math.log(float(power.mean()) / 3.0 + 0.25 * sigma**2)
        return cost + self._turn_cost(moved, track)

    def _turn_cost(self, moved: Displacements, track: TelemetryTrack) -> float:
        """Log-likelihood of the turns with their own spread.

        An attitude between two readings is less noisy than one at a reading. Unless that is allowed for, the best delay
        is one that puts all intervals between readings: 0.04 s wrong at 10 Hz whatever the flight.
        """
        both = turns(moved, track, self._R_b_c)
        trace = np.einsum("nij,nij->n", both.seen, both.told)
        share = 0.5 * (track.interpolation_variance(moved.from_s) + track.interpolation_variance(moved.to_s))
        squared = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)) ** 2 / share
        kept = np.sort(squared)[: max(3, int(_KEPT * len(trace)))]
        floor = (0.5 * self._config.sigma_attitude_rad) ** 2
        return 1.5 * len(trace) * math.log(float(np.mean(kept)) / 3.0 + floor)


def _least(delays_s: FloatArray, cost: FloatArray) -> Delay | None:
    """The minimum between the steps, if it is inside, sharp and alone."""
    best = int(np.argmin(cost))
    if not math.isfinite(cost[best]) or best in (0, len(delays_s) - 1):
        return None
    around = cost[best - 1 : best + 2]
    curvature = float(around[0] - 2.0 * around[1] + around[2]) / _STEP_S**2
    if curvature <= 0:
        return None
    offset = 0.5 * float(around[0] - around[2]) / (curvature * _STEP_S**2)
    sigma_s = math.sqrt(1.0 / curvature)
    far = np.abs(delays_s - delays_s[best]) > _VALLEY_S
    if sigma_s > _MOST_SIGMA_S or float(np.min(cost[far])) - cost[best] < _CLEARLY:
        return None
    return Delay(float(delays_s[best] + offset * _STEP_S), sigma_s)
