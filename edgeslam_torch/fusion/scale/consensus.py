"""Consensus of contradicting scale estimates: which are used, and warnings about the others.

The average of a right estimate and a wrong one is wrong. So opinions further apart than `CONTRADICTION` sigmas are
not averaged; the one with the worse evidence is dropped. The depth network's is always worse than that of the drone's
sensors where these confirm each other: all its keyframes share one error, whereas displacements and heights are many
independent measurements. One sensor alone may be in the wrong unit. Where that or a useless network are the two ways to
explain what is seen, neither is used.
"""

import math
from dataclasses import dataclass

from edgeslam_torch.fusion.scale.log_scale import LogScale

CONTRADICTION = 3.0
"""Sigmas of the difference; right opinions are that far apart in 0.3 % of the cases."""
_AT_ODDS = 5.0
AT_ODDS_LOG = math.log(1.5)
"""Sigmas and factor between two opinions beyond which one of them is nonsense."""
_WRONG_UNIT_LOG = 0.5 * math.log(10.0)
"""Units of velocity differ by tens: beyond half of that a wrong unit explains a contradiction better than any error."""


def contradict(a: LogScale, b: LogScale) -> bool:
    """Whether two opinions are too far apart to be averaged."""
    return _apart(a, b) > CONTRADICTION * math.hypot(a.sigma, b.sigma)


def at_odds(a: LogScale, b: LogScale) -> bool:
    """Whether one of two opinions must be nonsense, not merely off by more than it says."""
    return _apart(a, b) > max(AT_ODDS_LOG, _AT_ODDS * math.hypot(a.sigma, b.sigma))


def _apart(a: LogScale, b: LogScale) -> float:
    return abs(a.log_scale - b.log_scale)


def sided_with(one: LogScale, other: LogScale, witness: LogScale | None) -> LogScale | None:
    """Which of two contradictory opinions a third confirms; ``None`` when it confirms neither or both, or is none."""
    if witness is None:
        return None
    fits = [opinion for opinion in (one, other) if not contradict(opinion, witness)]
    return fits[0] if len(fits) == 1 else None


@dataclass(frozen=True, slots=True)
class Settled:
    """Estimates of drone and network that remain."""

    used: tuple[LogScale, ...]
    warning: str | None = None
    """Warning about dropped estimates."""


def settled_with_network(told: LogScale | None, network: LogScale | None, in_domain: bool) -> Settled:
    """Opinions of the drone's sensors and of the depth network or an atlas, less those that must be wrong.

    Args:
        told: By velocities, heights or both.
        network: By the depth network, or by the atlas in whose metres it had its part.
        in_domain: Whether the network may tell metres at all; if not, it may still contradict nonsense.
    """
    if told is None or network is None:
        return Settled(tuple(o for o in (told, network if in_domain else None) if o is not None))
    if not contradict(told, network):
        return Settled((told, network) if in_domain else (told,))
    scales = f"{math.exp(told.log_scale):.3g} and {math.exp(network.log_scale):.3g} metres per map unit"
    other, short = ("atlas", "atlas") if network.source == "atlas" else ("depth network", "network")
    said = f"telemetry ({told.source}) and the {other} contradict each other: {scales}"
    if "+" in told.source:
        return Settled((told,), f"{said}; velocities and heights confirm each other, so the {short} is not used")
    if _apart(told, network) > _WRONG_UNIT_LOG:
        return Settled((), f"{said}; one of them is nonsense, and neither is used: is telemetry in the right unit?")
    return Settled((told,), f"{said}; many measurements speak for telemetry, one error for the {other}: it is not used")
