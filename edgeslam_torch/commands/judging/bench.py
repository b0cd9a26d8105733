"""Accuracy and speed on recordings, beside published figures of other systems."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from edgeslam_torch.commands.judging._common import add_runs_to, recordings, say
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.output_file import output_file
from edgeslam_torch.help.options import positive_number, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    add_runs_to(parser, seeds=3)
    parser.add_argument(
        "--get",
        action="append",
        default=[],
        metavar="NAME",
        help="fetch this published recording first, and run only such; may be repeated ('readme': those of the README)",
    )
    parser.add_argument("--agree", action="store_true", help="agree to the licences of --get, which are printed")
    parser.add_argument("--mode", choices=("offline", "realtime"), default="offline")
    parser.add_argument(
        "--depth",
        action="append",
        default=[],
        metavar="FILE|NAME|none",
        help="compare depth networks: everything once with each; may be repeated ('default' is the shipped one)",
    )
    parser.add_argument(
        "--navigation", action="store_true", help="judge simulated flights to a goal instead (in lockstep)"
    )
    parser.add_argument(
        "--world", action="append", default=[], metavar="NAME", help="of those flights; may be repeated"
    )
    parser.add_argument("--fault", action="append", default=[], metavar="NAME|all", help="likewise (default: none)")
    parser.add_argument(
        "--behaviour",
        action="append",
        default=[],
        metavar="NAME",
        help="what they fly: goto (default), home, corridor or exits; may be repeated",
    )
    parser.add_argument("--first-seed", type=whole_number, default=0, metavar="N", help="of those flights (default: 0)")
    parser.add_argument(
        "--perception",
        choices=("truth", "slam", "udp"),
        default="truth",
        help="source of the planner's states: true pose and depth (default), the SLAM, or the SLAM over UDP in real "
        "time",
    )
    parser.add_argument("--jobs", type=positive_number, default=1, metavar="N", help="flights at a time (default: 1)")
    parser.add_argument("--json", type=output_file, metavar="FILE", help="also write the results here")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("A", "B"), help="only compare two results, A before B"
    )


def main(args: argparse.Namespace) -> int:
    """Run or compare; 1 when a run failed."""
    from edgeslam_torch.eval.benchmark import benchmark, rows
    from edgeslam_torch.eval.experiment.figures import compared, read_record

    _check_options(args)
    if args.navigation:
        return _navigation(args)
    if args.compare is not None:
        formats = range(1, benchmark.FORMAT + 1)
        before, after = (read_record(path, "bench", formats, "runs") for path in args.compare)
        print(compared(before, after, "runs", "sequence", benchmark.FIGURES))
        return 0
    data = recordings(args.data)
    if args.get:
        data, fetched = _fetched(args)
        args.sequence += fetched
    settings = benchmark.BenchSettings(
        data=data,
        seeds=tuple(range(args.seeds)),
        only=tuple(args.sequence),
        max_frames=args.max_frames,
        mode=args.mode,
        overrides=tuple(args.set),
    )
    if data is None:
        say("no recordings (--data or EDGESLAM_DATA): the synthetic flight alone")
    out = args.out or Path("runs") / time.strftime("bench-%Y%m%d-%H%M%S")
    if args.depth:
        result: dict[str, Any] = rows.compare_networks(settings, args.depth, out, say)
        runs = [run for record in result.values() for run in record["runs"]]
        text = rows.markdown_networks(result)
    else:
        result = benchmark.run_benchmark(settings, out, say)
        runs, text = result["runs"], benchmark.markdown_bench(result)
    if args.json is not None:
        write_text(args.json, json.dumps(result, indent=1, default=str) + "\n")
    if args.markdown is not None:
        write_text(args.markdown, text)
    print(text)
    if not args.depth:
        print(f"results: {out / 'bench.json'}")
    return 1 if any(run["error"] for run in runs) else 0


_OF_FLIGHTS: dict[str, object] = {
    "world": [],
    "fault": [],
    "behaviour": [],
    "first_seed": 0,
    "perception": "truth",
    "jobs": 1,
}
_OF_RECORDINGS: dict[str, object] = {
    "data": None, "sequence": [], "max_frames": None, "set": [], "get": [], "mode": "offline", "depth": [],
}  # fmt: skip
"""Options that only one kind of benchmark has, with their defaults."""


def _check_options(args: argparse.Namespace) -> None:
    """Refuse options of the other kind of benchmark, which would be ignored."""
    others = _OF_RECORDINGS if args.navigation else _OF_FLIGHTS
    given = [f"--{name.replace('_', '-')}" for name, unset in others.items() if getattr(args, name) != unset]
    if given:
        what = "are of recordings, not of --navigation" if args.navigation else "need --navigation"
        raise ConfigError(f"{', '.join(given)}: these options {what}")


def _fetched(args: argparse.Namespace) -> tuple[Path, list[str]]:
    """Folder of published recordings, and the names that the benchmark has for those of ``--get``."""
    from edgeslam_torch.datasets.consent import fetch, recordings_folder
    from edgeslam_torch.eval.inputs.dataset import open_dataset

    root = recordings_folder(args.data)
    return root, [open_dataset(root / recording.name).name for recording in fetch(args.get, root, args.agree, print)]


def _navigation(args: argparse.Namespace) -> int:
    """Flights through named worlds; 1 when one touched something, or failed."""
    from edgeslam_torch.eval.judge.navigation.behaviours import BEHAVIOURS, is_corridor
    from edgeslam_torch.eval.judge.navigation.flown import Case
    from edgeslam_torch.eval.judge.navigation.perception import FAULTS
    from edgeslam_torch.eval.judge.navigation.table import FAILED, judge_flights, markdown
    from edgeslam_torch.synthetic.sites.build import JUDGED, SITES

    worlds, behaviours = args.world or list(JUDGED), args.behaviour or ["goto"]
    faults = list(FAULTS)[1:] if args.fault == ["all"] else args.fault or ["none"]
    given = ((worlds, SITES, "--world"), (faults, FAULTS, "--fault"), (behaviours, BEHAVIOURS, "--behaviour"))
    for name, known, what in given:
        for wrong in (n for n in name if n not in known):
            raise ConfigError(f"{what}: unknown name {wrong!r}; there are {', '.join(known)}")
    out = args.out or Path("runs") / time.strftime("navigation-%Y%m%d-%H%M%S")
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    cases = [
        Case(world, seed, fault, args.perception, behaviour)
        for behaviour in behaviours
        for fault in faults
        for world in worlds
        for seed in seeds
        if behaviour != "corridor" or is_corridor(world)
    ]
    if not cases:
        raise ConfigError(f"--behaviour corridor: none of {', '.join(worlds)} is a corridor")
    flights = judge_flights(cases, out, args.jobs, say)
    if args.json is not None:
        write_text(args.json, json.dumps([flown.record() for flown in flights], indent=1) + "\n")
    if args.markdown is not None:
        write_text(args.markdown, markdown(flights))
    print(markdown(flights))
    print(f"results: {out / 'navigation.md'}")
    return 1 if any(flown.contacts or flown.ended.startswith(FAILED) for flown in flights) else 0
