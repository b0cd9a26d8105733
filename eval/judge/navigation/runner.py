"""Runs all flights in parallel; results are kept, so that an interrupted run resumes."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from edgeslam_torch.eval.judge.navigation.film import film_strip
from edgeslam_torch.eval.judge.navigation.flight import fly
from edgeslam_torch.eval.judge.navigation.flown import Case, Flown
from edgeslam_torch.eval.judge.navigation.pictures import top_view
from edgeslam_torch.eval.judge.navigation.table import markdown
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import write_image
from edgeslam_torch.jobs.watched import end_with_parent_process

FAILED = "failed"
"""Prefix of the ending of a flight that raised an error."""
_WORST = 6
"""Number of worst flights with a top view and a film strip."""


def judge_flights(cases: Sequence[Case], out: Path, jobs: int, say: Callable[[str], None]) -> list[Flown]:
    """Fly all cases, write a record each, ``navigation.md``, top views and film strips of the worst.

    Args:
        cases: Cases to fly.
        out: Output folder; results of the same cases in it are reused.
        jobs: Number of parallel flights.
        say: Called with a line for each finished flight.

    Returns:
        All flights. One that raised an error or whose process died counts as flown and not reached.
    """
    out.mkdir(parents=True, exist_ok=True)
    found = {case: flown for case in cases if (flown := _earlier(_file(out, case), case)) is not None}
    missing = [case for case in cases if case not in found]
    # Spawned: a forked process would inherit locks held by its parent's threads.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=end_with_parent_process) as pool:
        futures = {pool.submit(fly, case): case for case in missing}
        for future in as_completed(futures):
            case = futures[future]
            try:
                flown = future.result()
            except Exception as error:  # any error: the others continue, and this one is repeated in the next run
                flown = Flown(case, ended=f"{FAILED}: {type(error).__name__}: {error}")
            else:
                write_text(_file(out, case), json.dumps(flown.record()) + "\n")
            found[case] = flown
            say(_line(flown))
    flights = [found[case] for case in cases]
    write_text(out / "navigation.md", markdown(flights))
    seen = [flown for flown in flights if flown.track_w]
    for flown in sorted(seen, key=lambda f: (f.reached, not f.contacts, f.clearance_min_m))[:_WORST]:
        name = f"{_name(flown.case)}.png"
        write_image(out / f"top_{name}", top_view(flown))
        strip = film_strip(flown)
        if strip is not None:
            write_image(out / f"film_{name}", strip)
    return flights


def _name(case: Case) -> str:
    name = f"{case.world}_{case.seed}_{case.fault}_{case.perception}"
    return name if case.behaviour == "goto" else f"{name}_{case.behaviour}"


def _file(out: Path, case: Case) -> Path:
    return out / f"flight_{_name(case)}.json"


def _earlier(file: Path, case: Case) -> Flown | None:
    try:
        record = json.loads(file.read_text(encoding="utf-8"))
        return Flown(**{**record, "case": case, "dangers": tuple(record["dangers"])})
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None


def _line(flown: Flown) -> str:
    dangers = f"; {', '.join(flown.dangers)}" if flown.dangers else ""
    there, found, right = flown.exits
    return (
        f"{flown.case.behaviour} {flown.case.world} {flown.case.seed} {flown.case.fault} by {flown.case.perception}: "
        f"{flown.ended} after {flown.time_s:.1f} s "
        f"(oracle {flown.oracle_s:.1f}), {flown.distance_m:.2f} m from the goal, "
        f"{flown.home_m:.2f} m from the take-off, {flown.contacts} contacts, "
        f"exits: {right} of {there} found and {found - right} wrong, "
        f"clearance {flown.clearance_min_m:.2f} m{dangers}"
    )
