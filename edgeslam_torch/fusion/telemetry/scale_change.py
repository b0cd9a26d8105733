"""By how much refinement has enlarged what is remembered: metres per map unit shrink by as much.

A map's unit is free, and every refinement may change it by a percent. A scale is fitted to telemetry every few seconds
only; between two fits it goes along with the map.
"""

import math

import numpy as np

from edgeslam_torch.fusion.telemetry.visual_memory import Displacements
from edgeslam_torch.types import FloatArray

REACH_S = 30.0
"""Age of poses that are looked at."""
_SETTLED_S = 5.0
"""Age below which a window still mends single poses, which says nothing of the unit: ten keyframes at two a second."""
_LEAST_COUNT, _LEAST_SIGMAS = 4, 5.0
"""Displacements that must tell, and their length in standard deviations: shorter ones are noise in both."""


def grown(before: Displacements, after: Displacements, now_s: float) -> float:
    """Size of the map now over its size before; 1 where too little has moved to tell, or the map is no map any more.

    Args:
        before: Displacements as they were.
        after: The same, refined.
        now_s: Stamp of the newest frame.

    Raises:
        ValueError: If they are not the same intervals.
    """
    if len(before) != len(after):
        raise ValueError(f"{len(before)} intervals were {len(after)} before")
    then, now = (np.linalg.norm(d.moved, axis=1) for d in (before, after))
    age_s = now_s - before.to_s
    told = (age_s > _SETTLED_S) & (age_s < REACH_S) & (then > _LEAST_SIGMAS * before.sigma)
    if int(told.sum()) < _LEAST_COUNT:
        return 1.0
    ratio = _middle(now[told] / then[told], then[told] ** 2)
    return ratio if math.isfinite(ratio) and ratio > 0.0 else 1.0


def _middle(ratio: FloatArray, weight: FloatArray) -> float:
    """Weighted median: a new unit enlarges all displacements alike; what was mended changes a few, and by much."""
    order = np.argsort(ratio)
    up_to = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(up_to, 0.5 * up_to[-1])])
