"""Table of flights with confidence intervals."""

import math
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.eval.judge.navigation.flown import Flown

_Z = 1.959964
HEAD = (
    "| world | behaviour | fault | perception | flights | reached | contact | no contact and landed on the floor "
    "| clearance p5, min [m] "
    "| time over oracle | cruise [m/s] | CPU a tick, worst [ms] |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n"
)
NEAR_HEAD = (
    "\n| perception | sectors of 3.7° with an obstacle at 0.3 to 1 m | more than 0.3 m too far | less two sigmas "
    "| age of the newest depth, 95 % [s] |\n|---|---|---|---|---|\n"
)
OFF_HEAD = (
    "\n| perception | ticks with metric scale | pose error more than 0.1 m beyond three sigmas | flights with any "
    "| maximum error, median and worst [m] |\n|---|---|---|---|---|\n"
)
EXITS_HEAD = "\n| behaviour | perception | exits there | found | precision | recall |\n|---|---|---|---|---|---|\n"


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
    groups: dict[tuple[str, ...], list[Flown]] = {}
    for flown in flights:
        case = flown.case
        groups.setdefault((case.perception, case.behaviour, case.fault, case.world), []).append(flown)
    rows = [_row(key[::-1], groups[key]) for key in sorted(groups)]
    plain = [f for f in flights if f.case.fault == "none"]
    faulty = [f for f in flights if f.case.fault != "none"]
    for name, group in (("all", plain), ("all with a fault", faulty)):
        if len({(f.case.world, f.case.fault) for f in group}) > 1:
            perception, behaviour = (
                ", ".join(sorted({getattr(f.case, k) for f in group})) for k in ("perception", "behaviour")
            )
            rows.append(_row((name, "none" if group is plain else "any", behaviour, perception), group))
    return HEAD + "".join(rows) + _exits(flights) + _near(flights) + _off(flights)


def _exits(flights: Sequence[Flown]) -> str:
    """Table of exits; empty without any."""
    rows = []
    for perception, behaviour in sorted({(f.case.perception, f.case.behaviour) for f in flights}):
        group = [f.exits for f in flights if (f.case.perception, f.case.behaviour) == (perception, behaviour)]
        there, found, right = np.sum(group, axis=0).tolist()
        if there or found:
            shares = f"{_share(right, found)} | {_share(right, there)}"
            rows.append(f"| {behaviour} | {perception} | {there} | {found} | {shares} |\n")
    return EXITS_HEAD + "".join(rows) if rows else ""


def _near(flights: Sequence[Flown]) -> str:
    """Table of near-depth errors; empty without near obstacles."""
    rows = []
    for perception in sorted({f.case.perception for f in flights}):
        group = [f for f in flights if f.case.perception == perception]
        sectors, too_far, surely = np.sum([f.near for f in group], axis=0).tolist()
        if sectors:
            ages = [f.depth_age_s for f in group if math.isfinite(f.depth_age_s[0])] or [[math.nan, math.nan]]
            age = np.median(ages, axis=0)
            shares = f"{100 * too_far / sectors:.1f} % | {100 * surely / sectors:.1f} %"
            rows.append(f"| {perception} | {sectors} | {shares} | {age[0]:.2f}, {age[1]:.2f} |\n")
    return NEAR_HEAD + "".join(rows) if rows else ""


def _off(flights: Sequence[Flown]) -> str:
    """Table of inconsistent poses; empty without metric scale."""
    rows = []
    for perception in sorted({f.case.perception for f in flights}):
        group = [f for f in flights if f.case.perception == perception and f.off[0]]
        if group:
            moments, beyond = np.sum([f.off for f in group], axis=0).tolist()
            worst = [f.off_m for f in group]
            rows.append(
                f"| {perception} | {moments} | {100 * beyond / moments:.1f} % | {sum(f.off[1] > 0 for f in group)} of "
                f"{len(group)} | {np.median(worst):.2f}, {max(worst):.2f} |\n"
            )
    return OFF_HEAD + "".join(rows) if rows else ""


def _row(names: tuple[str, ...], group: Sequence[Flown]) -> str:
    """``names``: world, fault, behaviour, perception."""
    world, fault, behaviour, perception = names
    n = len(group)
    ratio = [f.time_s / f.oracle_s for f in group if f.reached and f.oracle_s]
    cruise = [f.cruise_m_s for f in group if math.isfinite(f.cruise_m_s)]
    cells = (
        world,
        behaviour,
        fault,
        perception,
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
