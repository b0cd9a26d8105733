"""Put each fault into a copy of the project and run its tests: ``make mutants``; survivors are what tests overlook.

``make mutants MUTANTS_ARGS="--only fusion"`` takes the faults whose list or name contains the word.
Exit status: 0 when at least 90 % are killed, every survivor has a sentence and no run timed out; 1 otherwise; 2 when
the lists do not fit the code or the tests fail without any fault.
"""

import argparse
import contextlib
import importlib.util
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import cache_from_source
from pathlib import Path

import pytest
from faults import ROOT, Fault, FaultError, applied, load, pytest_arguments, sources

MAX_SURVIVORS = 0.10
_PROCESSES = multiprocessing.get_context("forkserver")
_LOADED_ONCE = ["numpy", "cv2", "scipy.spatial.transform", "torch", "pytest", "hypothesis"]
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "runs", "site", "dist", "build", "__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache"
)
WALL_S = 900.0
"""A run of the tests that takes longer says nothing about the fault: they may hang, or the machine is busy."""


class Outcome(StrEnum):
    """What the tests say about a fault."""

    KILLED = "killed"
    SURVIVED = "SURVIVED"
    TIMED_OUT = "TIMED OUT"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one fault."""

    fault: Fault
    outcome: Outcome
    seconds: float
    words: str
    """The test that failed, or how else it ended."""


class Copies:
    """One copy of the project for each job."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self._free = []
        for job in range(jobs):
            copy = folder / f"copy{job}" / ROOT.name
            shutil.copytree(ROOT, copy, symlinks=True, ignore=LEFT_OUT)
            self._free.append(copy)
        self._lock = threading.Lock()

    def take(self) -> Path:
        """A free copy; there are as many copies as jobs."""
        with self._lock:
            return self._free.pop()

    def give_back(self, copy: Path) -> None:
        """Let others have it."""
        with self._lock:
            self._free.append(copy)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="WORD", help="in list or name; repeatable")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cpu-s", type=int, default=120, help="CPU time that one fault's tests may take")
    parser.add_argument("--list", action="store_true", help="check that the lists fit the code, and run nothing")
    parser.add_argument("--trust-tests", action="store_true", help="do not run the tests without a fault first")
    args = parser.parse_args(argv)
    try:
        every, files = load(), sources()
        ready = [(f, *applied(f, files), pytest_arguments(f)) for f in every]
    except FaultError as error:
        print(error, file=sys.stderr)
        return 2
    chosen = [r for r in ready if not args.only or any(w in f"{r[0].room}: {r[0].name}" for w in args.only)]
    print(f"{len(chosen)} of {len(every)} faults")
    if args.list or not chosen:
        return 0 if chosen else 2
    os.environ["OMP_NUM_THREADS"] = "1"
    _PROCESSES.set_forkserver_preload(_LOADED_ONCE)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copies = Copies(Path(folder), args.jobs)
        if not args.trust_tests and not _sound(copies, chosen, args.cpu_s):
            return 2
        with ThreadPoolExecutor(args.jobs) as pool:
            verdicts = list(pool.map(lambda r: _try(copies, *r, args.cpu_s), chosen))
    return report(verdicts)


def _sound(copies: Copies, chosen: list[tuple[Fault, Path, str, list[str]]], cpu_s: int) -> bool:
    """Whether the copy is what runs, and the tests pass in it without a fault."""
    copy = copies.take()
    try:
        for arguments in sorted({tuple(r[3]) for r in chosen}):
            status, output = _pytest(copy, list(arguments), cpu_s)
            if status != 0:
                print(f"without any fault: pytest {' '.join(arguments)}\n{output[-3000:]}", file=sys.stderr)
                return False
        return True
    finally:
        copies.give_back(copy)


def _try(copies: Copies, fault: Fault, path: Path, text: str, arguments: list[str], cpu_s: int) -> Verdict:
    copy = copies.take()
    target = copy / path.relative_to(ROOT)
    right = target.read_bytes()
    began = time.monotonic()
    try:
        _write(target, text.encode("utf-8"))
        outcome, words = judged(*_pytest(copy, arguments, cpu_s))
    finally:
        _write(target, right)
        copies.give_back(copy)
    verdict = Verdict(fault, outcome, time.monotonic() - began, words)
    print(f"{outcome:9} {verdict.seconds:5.1f} s  {fault.room}: {fault.name}  {words}", flush=True)
    return verdict


def _write(target: Path, content: bytes) -> None:
    """Without its byte code: two texts can have one size and second, and Python would run the older."""
    target.write_bytes(content)
    Path(cache_from_source(str(target))).unlink(missing_ok=True)


def judged(status: int | None, output: str) -> tuple[Outcome, str]:
    """Outcome of a run, and the test that failed or how else it ended.

    Args:
        status: pytest's exit status, negative for a signal, None when the wall clock ran out.
        output: What it printed.

    Raises:
        RuntimeError: If pytest itself failed.
    """
    if status == 0:
        return Outcome.SURVIVED, ""
    if status == pytest.ExitCode.NO_TESTS_COLLECTED:
        return Outcome.SURVIVED, "(no test was selected)"
    if status is None:
        return Outcome.TIMED_OUT, f"(not done after {WALL_S:.0f} s)"
    if status < 0:  # the limit of CPU time, the same on a busy machine: pytest's own limit would end an endless loop
        return Outcome.KILLED, f"({signal.Signals(-status).name})"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    if failed is None:  # nothing was tested: that must not pass for a fault that was noticed
        raise RuntimeError(f"pytest ended with status {status}:\n{output[-3000:]}")
    return Outcome.KILLED, failed[1].split("/")[-1]


def _pytest(copy: Path, arguments: list[str], cpu_s: int) -> tuple[int | None, str]:
    """Exit status (None when it is not done in time) and output of pytest in a copy, in a process of its own."""
    log = copy.parent / "pytest.log"
    log.write_bytes(b"")
    process = _PROCESSES.Process(target=_run_pytest, args=(copy, arguments, log, cpu_s))
    process.start()
    process.join(WALL_S)
    in_time = process.exitcode is not None
    with contextlib.suppress(ProcessLookupError):  # what it started goes with it
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    return process.exitcode if in_time else None, log.read_text(encoding="utf-8", errors="replace")


def _run_pytest(copy: Path, arguments: list[str], log: Path, cpu_s: int) -> None:
    """The process's work: forked from one that has loaded torch, so that this takes no two seconds for each fault."""
    os.setsid()
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
    os.chdir(copy)
    os.environ["PYTHONPATH"] = str(copy)
    sys.path.insert(0, str(copy))
    found = importlib.util.find_spec("edgeslam_torch")
    if found is None or not str(found.origin).startswith(str(copy)):
        print(f"the copy in {copy} is not what runs, but {found}")
        sys.exit(pytest.ExitCode.INTERNAL_ERROR)
    sys.exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--tb=line", *arguments]))


def report(verdicts: Sequence[Verdict]) -> int:
    """Print what stands out, and the exit status."""
    survivors = [v for v in verdicts if v.outcome is Outcome.SURVIVED]
    late = [v for v in verdicts if v.outcome is Outcome.TIMED_OUT]
    for verdict in survivors:
        fault = verdict.fault
        print(f"\nsurvived: {fault.room}: {fault.name} {verdict.words}\n  {fault.line}  ->  {fault.put}\n  {fault.why}")
        print(f"  {fault.survives or 'NO SENTENCE says why no test sees it'}")
    for verdict in verdicts:
        if verdict.outcome is Outcome.KILLED and verdict.fault.survives:
            print(f"\n{verdict.fault.room}: {verdict.fault.name}: is killed by now; take its sentence away")
    for verdict in late:
        print(f"\ntimed out, run it again: {verdict.fault.room}: {verdict.fault.name} {verdict.words}")
    share = len(survivors) / max(len(verdicts) - len(late), 1)
    killed = len(verdicts) - len(late) - len(survivors)
    print(f"\n{killed} of {len(verdicts)} killed, {len(survivors)} survived, {len(late)} timed out")
    unexplained = any(not v.fault.survives for v in survivors)
    return int(share > MAX_SURVIVORS or unexplained or bool(late))


if __name__ == "__main__":
    sys.exit(main())
