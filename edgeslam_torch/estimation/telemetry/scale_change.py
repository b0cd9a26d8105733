"""Change of the map's scale by refinement: metres per map unit change by the inverse.

A map's unit is free, and each refinement may change it by a percent. The scale is fitted to telemetry only every few
seconds and follows the map in between.
"""

import math

import numpy as np

from edgeslam_torch.estimation.telemetry.visual_memory import Displacements
from edgeslam_torch.types import FloatArray

REACH_S = 30.0
"""Maximum age of the poses compared."""
_SETTLED_S = 5.0
"""Age below which a window still refines single poses, independently of the unit: ten keyframes at two a second."""
_LEAST_COUNT, _LEAST_SIGMAS = 4, 5.0
"""Minimum number of displacements, and their minimum length in standard deviations."""


def grown(before: Displacements, after: Displacements, now_s: float) -> float:
    """Present size of the map over its previous size; 1 with too little motion, or after a degenerate update.

    Args:
        before: Displacements before the refinement.
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
    """Weighted median: a change of unit scales all displacements equally; local corrections change few, by much."""
    order = np.argsort(ratio)
    up_to = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(up_to, 0.5 * up_to[-1])])
