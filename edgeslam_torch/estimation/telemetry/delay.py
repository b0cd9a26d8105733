"""Video delay behind telemetry, estimated from the common motion."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.config import INTERVAL_S, FusionConfig
from edgeslam_torch.estimation.telemetry.alignment import map_to_world, turns
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements, VisualMemory
from edgeslam_torch.noise import ATTITUDE_RAD, CLOCK_S, VELOCITY_M_S
from edgeslam_torch.types import FloatArray

_MIN_DISPLACEMENTS = 8
"""Minimum number of displacements: the error then is 1.2 sigma RMS, at most 2.7; with six it reached 6 sigma."""
GROWTH = 1.3
"""Growth of the data after which the search is repeated."""
_GUESS_S = 0.5
"""Initial value: the middle of measured Tello delays (0.3 to 0.8 s)."""
_STEP_S = 0.05
_MARGIN_S = 0.1
"""Margin of the search around the configured range, so that a delay at its end is an interior minimum, and
`comparison`, which uses the same step, detects one beyond."""
_MOST_SIGMA_S = 0.05
_VALLEY_S = 0.15
_CLEARLY = 6.0
"""Minimum log-likelihood ratio to the second-best local minimum."""
_KEPT = 0.9
"""Share of the residuals used; the rest may be outliers."""


@dataclass(frozen=True, slots=True)
class Delay:
    """A frame stamped ``t`` shows what telemetry reported at ``t - value_s``."""

    value_s: float
    sigma_s: float
    """Infinite for the initial value, 0 when configured."""


class DelaySearch:
    """The current delay; the search is repeated as data grow."""

    def __init__(self, config: FusionConfig, R_b_c: FloatArray) -> None:
        self._config, self._R_b_c = config, R_b_c
        fixed = config.delay_s
        self.delay = Delay(_GUESS_S, math.inf) if fixed is None else Delay(fixed, 0.0)
        self._tried_at = 0

    def search(self, memory: VisualMemory, track: TelemetryTrack) -> None:
        """Find the delay at which visual and telemetry displacements and rotations agree best; unchanged if it is
        ambiguous."""
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
            self.delay = Delay(value_s, math.hypot(found.sigma_s, CLOCK_S))

    def _cost(self, delay_s: float, moved: Displacements, memory: VisualMemory, track: TelemetryTrack) -> float:
        """Negative log-likelihood of displacements, with the residuals' own variance, and of rotations."""
        R_w_m = map_to_world(memory.sightings(), track, delay_s, self._R_b_c)
        if R_w_m is None:
            return math.inf
        moved = moved.on_telemetry_clock(delay_s)
        seen = moved.moved @ R_w_m.T
        reported = track.displacement(moved.to_s) - track.displacement(moved.from_s)
        reported, seen = reported - reported.mean(axis=0), seen - seen.mean(axis=0)
        scale = float(np.sum(reported * seen) / max(float(np.sum(seen**2)), 1e-30))
        residual = reported - max(scale, 0.0) * seen
        power = np.sort(np.sum(residual**2, axis=1))[: max(3, int(_KEPT * len(residual)))]
        sigma = VELOCITY_M_S * math.sqrt(0.1 * INTERVAL_S)
        cost = 1.5 * len(residual) * math.log(float(power.mean()) / 3.0 + 0.25 * sigma**2)
        return cost + self._turn_cost(moved, track)

    def _turn_cost(self, moved: Displacements, track: TelemetryTrack) -> float:
        """Negative log-likelihood of the rotations with the residuals' own variance.

        An interpolated attitude is less noisy than a reading. Without a correction the best delay is one that puts all
        intervals between readings, a bias of 0.04 s at 10 Hz.
        """
        both = turns(moved, track, self._R_b_c)
        trace = np.einsum("nij,nij->n", both.seen, both.reported)
        share = 0.5 * (track.interpolation_variance(moved.from_s) + track.interpolation_variance(moved.to_s))
        squared = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)) ** 2 / share
        kept = np.sort(squared)[: max(3, int(_KEPT * len(trace)))]
        floor = (0.5 * ATTITUDE_RAD) ** 2
        return 1.5 * len(trace) * math.log(float(np.mean(kept)) / 3.0 + floor)


def _least(delays_s: FloatArray, cost: FloatArray) -> Delay | None:
    """Sub-step minimum, if it is inside the range, sharp and unique."""
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
