"""Flights as a table, with intervals that say how much so few flights can tell."""

import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.eval.judge.navigation.flight import Flown

_Z = 1.959964
HEAD = (
    "| world | fault | eyes | flights | goal reached | contact | no contact, on the floor in the end "
    "| clearance p5, min [m] "
    "| time over oracle | cruise [m/s] | CPU a tick, worst [ms] |\n|---|---|---|---|---|---|---|---|---|---|---|\n"
)
NEAR_HEAD = (
    "\n| eyes | sectors of 3.7 degrees with something at .3 to 1 m | told more than .3 m too far | less two sigmas |\n"
    "|---|---|---|---|\n"
)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927).

    Example:
        >>> [round(x, 3) for x in wilson(20, 20)], [round(x, 3) for x in wilson(10, 20)]
        ([0.839, 1.0], [0.299, 0.701])
    """
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, _Z * _Z
    middle = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = _Z * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(0.0, middle - half), min(1.0, middle + half)


def markdown(flights: Sequence[Flown]) -> str:
    """One row for every world and fault, and one for all static worlds without a fault."""
    groups: dict[tuple[str, str, str], list[Flown]] = {}
    for flown in flights:
        groups.setdefault((flown.case.eyes, flown.case.fault, flown.case.world), []).append(flown)
    rows = [_row(world, fault, eyes, group) for (eyes, fault, world), group in sorted(groups.items())]
    plain = [f for f in flights if f.case.fault == "none"]
    faulty = [f for f in flights if f.case.fault != "none"]
    for name, group in (("all", plain), ("all with a fault", faulty)):
        if len({(f.case.world, f.case.fault) for f in group}) > 1:
            eyes = ", ".join(sorted({f.case.eyes for f in group}))
            rows.append(_row(name, "none" if group is plain else "any", eyes, group))
    return HEAD + "".join(rows) + _near(flights)


def _near(flights: Sequence[Flown]) -> str:
    """A second table, of what is near and told to be far; nothing where nothing was near."""
    rows = []
    for eyes in sorted({f.case.eyes for f in flights}):
        sectors, too_far, surely = np.sum([f.near for f in flights if f.case.eyes == eyes], axis=0).tolist()
        if sectors:
            rows.append(f"| {eyes} | {sectors} | {100 * too_far / sectors:.1f} % | {100 * surely / sectors:.1f} % |\n")
    return NEAR_HEAD + "".join(rows) if rows else ""


def _row(world: str, fault: str, eyes: str, group: Sequence[Flown]) -> str:
    n = len(group)
    ratio = [f.time_s / f.oracle_s for f in group if f.reached]
    cruise = [f.cruise_m_s for f in group if math.isfinite(f.cruise_m_s)]
    cells = (
        world,
        fault,
        eyes,
        str(n),
        _share(sum(f.reached for f in group), n),
        _share(sum(f.contacts > 0 for f in group), n),
        _share(sum(f.landed and not f.contacts for f in group), n),
        f"{np.median([f.clearance_p5_m for f in group]):.2f}, {min(f.clearance_min_m for f in group):.2f}",
        f"{np.median(ratio):.2f}" if ratio else "",
        f"{np.median(cruise):.2f}" if cruise else "",
        f"{np.median([f.cpu_ms for f in group]):.1f}, {max(f.cpu_worst_ms for f in group):.0f}",
    )
    return "| " + " | ".join(cells) + " |\n"


def _share(successes: int, trials: int) -> str:
    low, high = wilson(successes, trials)
    return f"{successes} ({100 * low:.0f} to {100 * high:.0f} %)"
