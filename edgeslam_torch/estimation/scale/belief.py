r"""Where the metric scale is decided.

The essential matrix gives translation up to scale, and the paper does not say how metric scale enters. Here each source
(velocities, heights, IMU, depth network, an earlier flight's map) gives a `ScaleBelief`: the log of metres per map unit
with a standard deviation. `decide` averages those that agree.

The average of a right estimate and a wrong one is wrong. So estimates that fail the gate are not averaged: the
consistent group with the most votes is used. The depth network has a little less than one: its error is common to
all keyframes, whereas displacements and heights are many independent measurements; an IMU has more than two, since its
unit cannot be mistaken. A single sensor may be in the wrong unit. If that and a wrong network are both plausible,
neither is used.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.gate import passes
from edgeslam_torch.types import ScaleEstimate

MOST_SIGMA = 0.5
"""Relative sigma above which a scale counts as unknown."""
_CONFIDENCE = 0.997
"""Share of pairs of correct estimates that pass: three sigmas."""
_GROSS_LOG = math.log(1.5)
"""Difference beyond which one of two sensors is a gross error; up to it a bent map explains both."""
_WRONG_UNIT_LOG = 0.5 * math.log(10.0)
"""Half a decade: beyond it a wrong unit of velocity (a power of ten) is the most likely cause of a contradiction."""
_VOTES = {"imu": 2.5, "telemetry": 1.0, "height": 1.0, "depth": 0.9, "atlas": 0.9}
_NAMES = {
    "imu": "the IMU",
    "telemetry": "telemetry's velocities",
    "height": "telemetry's heights",
    "depth": "the depth network",
    "atlas": "the atlas",
}


@dataclass(frozen=True, slots=True)
class ScaleBelief:
    """One source's estimate of the logarithm of metres per map unit."""

    log_scale: float
    sigma: float
    source: str
    """A key of `_VOTES`, or several with plus signs."""

    @property
    def estimate(self) -> ScaleEstimate:
        """The estimate in metres per map unit."""
        value = math.exp(self.log_scale)
        return ScaleEstimate(value, value * self.sigma, self.source)


def contradict(a: ScaleBelief, b: ScaleBelief) -> bool:
    """Whether two estimates are inconsistent: their average would be wrong."""
    difference = np.array([a.log_scale - b.log_scale])
    return not passes(difference, np.array([[a.sigma**2 + b.sigma**2]]), _CONFIDENCE)


@dataclass(frozen=True, slots=True)
class Decision:
    """Which estimates are used."""

    used: tuple[ScaleBelief, ...] = ()
    rejected: frozenset[str] = frozenset()
    """Sources of those that contradict them."""
    warning: str | None = None


def decide(beliefs: Sequence[ScaleBelief], only_witness: bool = False) -> Decision:
    """Choose the estimates to average.

    Args:
        beliefs: One a source.
        only_witness: The depth network is out of its domain: it has a vote but is not used.
    """
    groups = [
        group
        for size in range(1, len(beliefs) + 1)
        for group in itertools.combinations(beliefs, size)
        if not any(contradict(a, b) for a, b in itertools.combinations(group, 2))
    ]
    if not groups:
        return Decision()
    votes = [round(sum(_VOTES[one.source] for one in group), 6) for group in groups]
    best = [group for group, count in zip(groups, votes, strict=True) if count == max(votes)]
    used = tuple(one for one in beliefs if any(one in group for group in best))
    rejected = [one for one in beliefs if one not in used]
    tied = [(a, b) for a, b in itertools.combinations(used, 2) if contradict(a, b)]  # of groups with as many votes
    pairs = tied or [(a, b) for a in used for b in rejected if contradict(a, b)]
    if not pairs:
        return Decision(tuple(b for b in used if not (only_witness and b.source == "depth")))
    one, other = max(pairs, key=lambda pair: _gap(*pair))
    said = f"{_NAMES[one.source]} and {_NAMES[other.source]} contradict each other: "
    said += f"{one.estimate.value:.3g} and {other.estimate.value:.3g} metres per map unit"
    if max(votes) <= 1.0 and _gap(one, other) > (_GROSS_LOG if tied else _WRONG_UNIT_LOG):
        return Decision((), frozenset(b.source for b in beliefs), f"{said}; neither is used: the right unit?")
    if rejected:
        said += f"; not used: {', '.join(_NAMES[b.source] for b in rejected)}"
    return Decision(
        tuple(b for b in used if not (only_witness and b.source == "depth")),
        frozenset(b.source for b in rejected),
        said,
    )


def _gap(a: ScaleBelief, b: ScaleBelief) -> float:
    return abs(a.log_scale - b.log_scale)


def mean(beliefs: Sequence[ScaleBelief], inside: int = 0) -> ScaleBelief | None:
    """Information-weighted mean of independent estimates; sigma grows with their disagreement.

    Args:
        beliefs: The estimates.
        inside: Degrees of freedom inside them, if some are means of several: their scatter is in their sigmas already,
            and two sensors that agree say more of a third estimate than one.
    """
    if not beliefs:
        return None
    log_scale = np.array([b.log_scale for b in beliefs])
    weight = np.array([b.sigma for b in beliefs]) ** -2.0
    centre = float(np.sum(weight * log_scale) / np.sum(weight))
    sigma = float(np.sum(weight)) ** -0.5
    if len(beliefs) > 1:  # Birge ratio: estimates that disagree beyond their sigmas widen the result
        scatter = float(np.sum(weight * (log_scale - centre) ** 2)) + inside
        sigma *= max(1.0, math.sqrt(scatter / (len(beliefs) - 1 + inside)))
    if any(contradict(a, b) for a, b in itertools.combinations(beliefs, 2)):  # it may be that of either
        sigma = max(sigma, float(np.ptp(log_scale)))
    return ScaleBelief(centre, sigma, "+".join(dict.fromkeys(b.source for b in beliefs)))


def disagreement(sources: Sequence[ScaleEstimate]) -> float:
    """Largest distance between two sources in the logarithm, in standard deviations of their difference."""
    return max(
        (
            abs(math.log(a.value / b.value)) / math.hypot(a.sigma / a.value, b.sigma / b.value)
            for a, b in itertools.combinations(sources, 2)
        ),
        default=0.0,
    )
