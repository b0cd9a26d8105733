"""Scale of the last seconds alone, to detect a scale change within the map.

A fit over the whole flight rejects recent contradictory data as outliers. If a map's scale collapses, as after a
take-off without parallax, all new data contradict all old data, and the fit stays confident. The ratio of the recent
telemetry displacement to the visual one needs no fit.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.scale.consensus import AT_ODDS_LOG
from edgeslam_torch.estimation.scale.log_scale import LogScale
from edgeslam_torch.types import FloatArray

PRESENT_S = 4.0
"""Length of the window: two metres at 0.5 m/s."""
_LEAST_COUNT, _LEAST_WAY_M = 3, 0.8
_SAME_WAY = 0.9
"""Minimum cosine of the angle between both displacements: 26 degrees."""
_LEAST_SIGMA = 0.05
_OF_STEP = 0.4
"""Standard deviation of a velocity that is rounded or truncated with equal probability [steps]."""


@dataclass(frozen=True, slots=True)
class Parted:
    """A present scale that contradicts the flight's."""

    now: LogScale
    before: LogScale

    def warning(self) -> str:
        """Warning for health and summary."""
        now, before = math.exp(self.now.log_scale), math.exp(self.before.log_scale)
        return (
            f"the map has changed its scale: {now:.3g} metres per unit by the velocities of the last "
            f"{PRESENT_S:.0f} s, {before:.3g} by the flight before; the present one counts"
        )


def present_scale(
    moved_map: FloatArray, moved_m: FloatArray, duration_s: FloatArray, step_m_s: float
) -> LogScale | None:
    """Metres per map unit of the displacements ``(N, 3)`` of the last seconds; None if too short or inconsistent.

    Args:
        moved_map: Visual, in world axes [map units].
        moved_m: By telemetry, over the same intervals [m].
        duration_s: Their lengths ``(N,)``.
        step_m_s: Quantisation step of the velocities.
    """
    if len(moved_map) < _LEAST_COUNT:
        return None
    told, seen = np.linalg.norm(moved_m, axis=1), np.linalg.norm(moved_map, axis=1)
    way_m, way = float(told.sum()), float(seen.sum())
    if way_m < _LEAST_WAY_M or not way > 0:
        return None
    along = float(np.sum(moved_m * moved_map))
    if along < _SAME_WAY * float(np.sum(told * seen)):
        return None
    speed = way_m / float(duration_s.sum())
    ratio = told[seen > 0] / seen[seen > 0]
    spread = float(np.std(np.log(np.maximum(ratio, 1e-9)))) / math.sqrt(len(ratio))
    sigma = math.hypot(_LEAST_SIGMA, spread, _OF_STEP * step_m_s / speed)
    return LogScale(math.log(way_m / way), sigma, "telemetry")


def has_changed(now: LogScale, moved_map: FloatArray, moved_m: FloatArray) -> bool:
    """Whether the displacements before ``(N, 3)`` had another scale: a wrong unit would be wrong all the time."""
    told, seen = (float(np.linalg.norm(way, axis=1).sum()) for way in (moved_m, moved_map))
    return told > 0 and seen > 0 and abs(now.log_scale - math.log(told / seen)) > AT_ODDS_LOG
