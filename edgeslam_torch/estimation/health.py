"""Consistency of the scale's sources."""

import itertools
import math
from collections.abc import Sequence

from edgeslam_torch.types import ScaleEstimate


def disagreement(sources: Sequence[ScaleEstimate]) -> float:
    """Largest distance between two sources in the logarithm, in standard deviations of their difference."""
    return max((_sigmas_between(a, b) for a, b in itertools.combinations(sources, 2)), default=0.0)


def _sigmas_between(a: ScaleEstimate, b: ScaleEstimate) -> float:
    return abs(math.log(a.value / b.value)) / math.hypot(a.sigma / a.value, b.sigma / b.value)
