"""All judged flights: run in processes of their own, kept, and summed up in tables with confidence intervals."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.experiment.conditions import code_state
from edgeslam_torch.eval.experiment.figures import markdown_table
from edgeslam_torch.eval.experiment.runner import Local, Task, check_own, run_all
from edgeslam_torch.eval.judge.navigation.flown import Case, Flown
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.jobs.watched import Limits

TABLE, FLIGHTS = "navigation.md", "flights"
"""Names in the output folder."""
FAILED = "failed"
"""Prefix of the ending of a flight that raised an error."""
_TIMEOUT_S = 3600.0
Line = dict[str, str]
"""Of a table, by the columns' titles."""


def judge_flights(cases: Sequence[Case], out: Path, jobs: int, say: Callable[[str], None]) -> list[Flown]:
    """Fly all cases, ``jobs`` at a time, and write ``navigation.md``; results of the same cases and code are reused.

    Returns:
        All flights. One that raised an error or whose process died counts as flown and not reached.

    Raises:
        OutputError: If ``out`` holds what no such judge wrote.
    """
    check_own(out, FLIGHTS, (), TABLE)
    commit = code_state()
    tasks = {
        case: Task(
            out / FLIGHTS,
            case.name,
            "edgeslam_torch.eval.judge.navigation.table:run_flight",
            {"commit": commit, "flight": asdict(case)},
        )
        for case in cases
    }
    flights = run_all(tasks, Local(jobs, Limits(_TIMEOUT_S)), _flown, _line, say)
    done = [flights[case] for case in cases]
    write_text(out / TABLE, markdown(done))
    return done


def run_flight(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What the process of a case does."""
    from edgeslam_torch.eval.judge.navigation.flight import fly
    from edgeslam_torch.eval.judge.navigation.over_udp import fly_over_udp

    given = Case(**case["flight"])
    return {"flown": (fly_over_udp if given.perception == "udp" else fly)(given).record()}


def _flown(case: Case, found: dict[str, Any] | None, error: str) -> Flown:
    return Flown.of_record(found["flown"]) if found is not None else Flown(case, ended=f"{FAILED}: {error}")


def _line(case: Case, flown: Flown) -> str:
    there, found, right = flown.exits
    dangers = f"; {', '.join(flown.dangers)}" if flown.dangers else ""
    return (
        f"{case.behaviour} {case.world} {case.seed} {case.fault} by {case.perception}: "
        f"{flown.ended} after {flown.time_s:.1f} s (oracle {flown.oracle_s:.1f}), "
        f"{flown.distance_m:.2f} m from the goal, {flown.home_m:.2f} m from the take-off, {flown.contacts} contacts, "
        f"exits: {right} of {there} found and {found - right} wrong, clearance {flown.clearance_min_m:.2f} m{dangers}"
    )


def _share(successes: int, trials: int) -> str:
    """Number and 95 % interval of its share (Wilson 1927)."""
    from scipy.stats import binomtest  # a second to import

    low, high = binomtest(successes, trials).proportion_ci(method="wilson") if trials else (0.0, 1.0)
    return f"{successes} ({100 * low:.0f} to {100 * high:.0f} %)"


def markdown(flights: Sequence[Flown]) -> str:
    """One row for every world and fault, and one for all static worlds without a fault; tables of exits and
    of inconsistent poses where there are any."""
    by_case = _grouped(flights, "perception", "behaviour", "fault", "world")
    rows = [_row(key[::-1], group) for key, group in by_case.items()]
    plain = [f for f in flights if f.case.fault == "none"]
    faulty = [f for f in flights if f.case.fault != "none"]
    for names, group in ((("all", "none"), plain), (("all with a fault", "any"), faulty)):
        if len({(f.case.world, f.case.fault) for f in group}) > 1:
            kinds = (", ".join(sorted({getattr(f.case, k) for f in group})) for k in ("behaviour", "perception"))
            rows.append(_row((*names, *kinds), group))
    exits = [_exits_row(key, group) for key, group in _grouped(flights, "perception", "behaviour").items()]
    off = [_off_row(name, [f for f in group if f.off[0]]) for (name,), group in _grouped(flights, "perception").items()]
    tables = [known for lines in (rows, exits, off) if (known := [[*line.items()] for line in lines if line])]
    return "\n".join(
        markdown_table([title for title, _ in lines[0]], [[cell for _, cell in line] for line in lines]) + "\n"
        for lines in tables
    )


def _grouped(flights: Sequence[Flown], *names: str) -> dict[tuple[str, ...], list[Flown]]:
    groups: dict[tuple[str, ...], list[Flown]] = {}
    for flown in flights:
        groups.setdefault(tuple(getattr(flown.case, name) for name in names), []).append(flown)
    return dict(sorted(groups.items()))


def _exits_row(names: tuple[str, ...], group: Sequence[Flown]) -> Line:
    there, found, right = np.sum([f.exits for f in group], axis=0).tolist()
    if not there and not found:
        return {}
    shares = {"precision": _share(right, found), "recall": _share(right, there)}
    return {"behaviour": names[1], "perception": names[0], "exits there": f"{there}", "found": f"{found}"} | shares


def _off_row(perception: str, group: Sequence[Flown]) -> Line:
    if not group:
        return {}
    moments, beyond = np.sum([f.off for f in group], axis=0).tolist()
    worst = [f.off_m for f in group]
    return {
        "perception": perception,
        "ticks with metric scale": f"{moments}",
        "pose error more than 0.1 m beyond three sigmas": f"{100 * beyond / moments:.1f} %",
        "flights with any": f"{sum(f.off[1] > 0 for f in group)} of {len(group)}",
        "maximum error, median and worst [m]": f"{np.median(worst):.2f}, {max(worst):.2f}",
    }


def _row(names: tuple[str, ...], group: Sequence[Flown]) -> Line:
    """``names``: world, fault, behaviour, perception."""
    world, fault, behaviour, perception = names
    n = len(group)
    ratio = [f.time_s / f.oracle_s for f in group if f.reached and f.oracle_s]
    cruise = [f.cruise_m_s for f in group if math.isfinite(f.cruise_m_s)]
    clearance_m = np.median([f.clearance_p5_m for f in group]), min(f.clearance_min_m for f in group)
    cpu_ms = np.median([f.cpu_ms for f in group]), max(f.cpu_worst_ms for f in group)
    return {
        "world": world,
        "behaviour": behaviour,
        "fault": fault,
        "perception": perception,
        "flights": str(n),
        "reached": _share(sum(f.reached for f in group), n),
        "contact": _share(sum(f.contacts > 0 for f in group), n),
        "no contact and landed on the floor": _share(sum(f.landed and not f.contacts for f in group), n),
        "clearance p5, min [m]": f"{clearance_m[0]:.2f}, {clearance_m[1]:.2f}",
        "time over oracle": f"{np.median(ratio):.2f}" if ratio else "",
        "cruise [m/s]": f"{np.median(cruise):.2f}" if cruise else "",
        "CPU a tick, worst [ms]": f"{cpu_ms[0]:.1f}, {cpu_ms[1]:.0f}",
    }
