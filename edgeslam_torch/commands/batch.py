"""Run, evaluate and report many recordings: one page and one table of all."""

import argparse
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, SourceError
from edgeslam_torch.help.options import EXIT_INTERRUPTED, add_settings, positive_amount, positive_number, say

if TYPE_CHECKING:
    from edgeslam_torch.eval.experiment.runner import Runner
    from edgeslam_torch.fleet.folder import BatchSettings
    from edgeslam_torch.fleet.manifest import Flight

MEMORY_MB = 4000.0
"""Seven times what a flight of half a minute takes."""
_SHARE = 0.8
"""Of this machine's memory for all flights together; the rest is for what else runs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "manifest",
        nargs="+",
        metavar="MANIFEST",
        help="folder of recordings, recording, pattern in quotes, or a .csv table with the columns recording, name, "
        "camera, telemetry, topic, truth, settings (all but the first may be left out)",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="results; finished flights are not repeated"
    )
    parser.add_argument("--jobs", type=positive_number, metavar="N", help="flights at a time (default: one a core)")
    parser.add_argument(
        "--ray", metavar="auto|ADDRESS", help="run on a Ray cluster ([fleet] extra): auto is this machine's"
    )
    parser.add_argument(
        "--timeout", type=positive_amount, default=3600.0, metavar="S", help="of one flight (default: 3600)"
    )
    parser.add_argument(
        "--memory",
        type=positive_amount,
        metavar="MB",
        help="most memory of a flight (default: 4000, or an equal share of 80 %% of this machine's if that is less)",
    )
    add_settings(parser, " of all flights")
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop every flight after N frames")
    parser.add_argument("--seed", type=int, help="seed of the robust estimators (default: 0)")
    parser.add_argument(
        "--map-score", action="store_true", help="compare maps with measured depth too (slower, a gigabyte each)"
    )


def main(args: argparse.Namespace) -> int:
    """Run what is missing; 1 when a flight failed."""
    from edgeslam_torch.fleet.batch import run_batch
    from edgeslam_torch.fleet.folder import PAGE, TABLE
    from edgeslam_torch.fleet.manifest import read_manifests
    from edgeslam_torch.fleet.table import FAILED, counts

    flights = _without(read_manifests(args.manifest), args.out)
    try:
        rows = run_batch(flights, _settings(args), args.out, _runner(args), say)
    except KeyboardInterrupt:
        say(f"interrupted; {args.out} holds what was finished; run the same command to continue")
        return EXIT_INTERRUPTED
    failed = [row for row in rows if row.state == FAILED]
    for row in failed:
        print(str(row))
    print(f"{counts(rows)['done']} of {len(rows)} flights finished, {len(failed)} failed")
    print(f"results: {args.out / PAGE}, {args.out / TABLE}")
    return 1 if failed else 0


def _without(flights: "list[Flight]", out: Path) -> "list[Flight]":
    """Flights but for the batch's own folder, which may lie among the recordings."""
    kept = [flight for flight in flights if flight.recording.resolve() != out.resolve()]
    if not kept:
        raise SourceError(f"{out}: is the only folder there; give recordings")
    return kept


def _settings(args: argparse.Namespace) -> "BatchSettings":
    from edgeslam_torch.commands.run import resolved_config
    from edgeslam_torch.fleet.folder import BatchSettings

    if args.depth is not None and os.path.exists(args.depth):
        args.depth = os.path.abspath(args.depth)  # also for processes elsewhere
    return BatchSettings(resolved_config(args), args.max_frames, args.map_score)


def _runner(args: argparse.Namespace) -> "Runner":
    from edgeslam_torch.eval.experiment.runner import Local
    from edgeslam_torch.jobs.watched import Limits

    if args.ray is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        jobs = args.jobs or cores
        limits = Limits(args.timeout, args.memory or min(MEMORY_MB, _SHARE * _memory_mb() / jobs))
        return Local(jobs, limits, retries=1)
    from edgeslam_torch.fleet.on_ray import OnRay

    if args.jobs is not None:
        raise ConfigError("--jobs is for this machine; a Ray cluster runs one flight a CPU")
    return OnRay(args.ray, Limits(args.timeout, args.memory or MEMORY_MB))


def _memory_mb() -> float:
    """Of this machine; without end where it is not known."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    except (AttributeError, ValueError, OSError):
        return math.inf
