"""Consensus of contradictory scale estimates.

The average of a right estimate and a wrong one is wrong, so estimates further apart than `CONTRADICTION` sigmas are not
averaged; the one with weaker evidence is rejected. The depth network is weaker than sensors that confirm each other:
its error is common to all keyframes, whereas displacements and heights are many independent measurements. A single
sensor may be in the wrong unit. If that and a wrong network are both plausible, neither is used.
"""

import math
from dataclasses import dataclass

from edgeslam_torch.estimation.scale.log_scale import LogScale

CONTRADICTION = 3.0
"""Maximum difference of consistent estimates [sigmas], exceeded by chance in 0.3 % of the cases."""
_AT_ODDS = 5.0
_AT_ODDS_LOG = math.log(1.5)
"""Difference in sigmas and factor beyond which one of two estimates is a gross error."""
_WRONG_UNIT_LOG = 0.5 * math.log(10.0)
"""Half a decade: beyond it a wrong unit of velocity (a power of ten) is the most likely cause of a contradiction."""


def contradict(a: LogScale, b: LogScale) -> bool:
    """Whether two estimates are too far apart to be averaged."""
    return _apart(a, b) > CONTRADICTION * math.hypot(a.sigma, b.sigma)


def at_odds(a: LogScale, b: LogScale) -> bool:
    """Whether one of two estimates must be a gross error, not merely overconfident."""
    return _apart(a, b) > max(_AT_ODDS_LOG, _AT_ODDS * math.hypot(a.sigma, b.sigma))


def _apart(a: LogScale, b: LogScale) -> float:
    return abs(a.log_scale - b.log_scale)


def sided_with(one: LogScale, other: LogScale, witness: LogScale | None) -> LogScale | None:
    """Which of two contradictory estimates a third supports; ``None`` if it supports neither or both, or is missing."""
    if witness is None:
        return None
    fits = [opinion for opinion in (one, other) if not contradict(opinion, witness)]
    return fits[0] if len(fits) == 1 else None


@dataclass(frozen=True, slots=True)
class Settled:
    """Estimates of drone and network that are used."""

    used: tuple[LogScale, ...]
    warning: str | None = None
    """Warning about rejected estimates."""


def settled_with_network(reported: LogScale | None, network: LogScale | None, in_domain: bool) -> Settled:
    """Reject contradictory estimates of the drone's sensors and of the depth network or an atlas.

    Args:
        reported: By velocities, heights or both.
        network: By the depth network, or by an atlas, whose metres include the network's estimate.
        in_domain: Whether the network may determine the scale; otherwise it only serves to detect gross errors.
    """
    if reported is None or network is None:
        return Settled(tuple(o for o in (reported, network if in_domain else None) if o is not None))
    if not contradict(reported, network):
        return Settled((reported, network) if in_domain else (reported,))
    scales = f"{math.exp(reported.log_scale):.3g} and {math.exp(network.log_scale):.3g} metres per map unit"
    other, short = ("atlas", "atlas") if network.source == "atlas" else ("depth network", "network")
    said = f"telemetry ({reported.source}) and the {other} contradict each other: {scales}"
    if "+" in reported.source:
        return Settled((reported,), f"{said}; velocities and heights confirm each other, so the {short} is not used")
    if _apart(reported, network) > _WRONG_UNIT_LOG:
        return Settled((), f"{said}; one of them is nonsense, and neither is used: is telemetry in the right unit?")
    return Settled(
        (reported,), f"{said}; many measurements speak for telemetry, one error for the {other}: it is not used"
    )
