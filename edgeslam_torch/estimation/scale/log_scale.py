r"""Metric scale of a monocular map with its uncertainty, from displacements, height and predicted depth.

The essential matrix gives translation up to scale, and the paper does not say how metric scale enters. Here each source
gives :math:`\log s` (metres per map unit) with a standard deviation, and the three are fused in the log domain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.types import ScaleEstimate


@dataclass(frozen=True, slots=True)
class LogScale:
    """One source's estimate of the logarithm of metres per map unit."""

    log_scale: float
    sigma: float
    source: str


def fuse(opinions: Sequence[LogScale]) -> ScaleEstimate:
    """Information-weighted mean of independent estimates; sigma grows with their disagreement."""
    if not opinions:
        return ScaleEstimate()
    log_scale = np.array([o.log_scale for o in opinions])
    weight = np.array([o.sigma for o in opinions]) ** -2.0
    mean = float(np.sum(weight * log_scale) / np.sum(weight))
    sigma = float(np.sum(weight)) ** -0.5
    if len(opinions) > 1:  # Birge ratio: estimates that disagree beyond their sigmas widen the result
        birge = math.sqrt(float(np.sum(weight * (log_scale - mean) ** 2)) / (len(opinions) - 1))
        sigma *= max(1.0, birge)
    names = dict.fromkeys(o.source for o in opinions)
    value = math.exp(mean)
    return ScaleEstimate(value, value * sigma, "+".join(names))
