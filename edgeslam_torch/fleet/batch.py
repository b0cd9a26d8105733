"""Runs the flights of a batch that have no result yet, and keeps one table and one page of all."""

import os
import subprocess
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from edgeslam_torch.fleet.folder import FLIGHTS, JOBS, LOG, PICTURES, BatchFolder, BatchSettings, Task
from edgeslam_torch.fleet.manifest import Flight
from edgeslam_torch.fleet.page import write_page
from edgeslam_torch.fleet.table import DONE, FAILED, WAITING, Row, write_tables
from edgeslam_torch.jobs.watched import Ended, Job, Limits, Start, run_each, start_module
from edgeslam_torch.writers.own_folder import FolderLock

WRITE_EVERY_S = 5.0
"""Table and page are written again after this time, and at the end."""


class Runner(Protocol):
    """Runs tasks, on this machine or on others."""

    def __call__(self, tasks: Sequence[Task], prepare: Callable[[Task], Path]) -> Generator[tuple[Task, Ended]]:
        """Tasks with the ends of their processes, as they come; closing it ends what still runs.

        Args:
            tasks: What to run.
            prepare: Makes the folder of a task, called right before it is run.
        """


def start_flight(folder: Path, log: IO[str]) -> subprocess.Popen[str]:
    """The process of a task's folder."""
    return start_module("edgeslam_torch.fleet.run_flight", folder, log)


@dataclass(frozen=True, slots=True)
class Local:
    """Runs tasks on this machine, each in a process of its own on one thread."""

    processes: int
    limits: Limits
    retries: int = 1
    """Repetitions after a process was killed from outside."""
    start: Start = start_flight

    def __call__(self, tasks: Sequence[Task], prepare: Callable[[Task], Path]) -> Generator[tuple[Task, Ended]]:
        """See `Runner`."""
        return run_each(tasks, lambda task: self.job(prepare(task)), self.processes, self.retries)

    def job(self, folder: Path) -> Job:
        """The watched process of a task's folder."""
        return Job(folder, folder / LOG, self.start, self.limits)


def run_batch(
    flights: Sequence[Flight], settings: BatchSettings, out: Path, runner: Runner, say: Callable[[str], None]
) -> list[Row]:
    """Run what has no result in ``out``; table and page there are of all flights, also after an interrupt.

    Args:
        flights: With different names.
        settings: How.
        out: The batch's folder; one batch at a time.
        runner: `Local`, or one of a cluster.
        say: Told one line for every flight that ended.

    Returns:
        A row for every flight, in their order.

    Raises:
        ConfigError: If a flight's settings are malformed; nothing was run then.
        OutputError: If ``out`` holds something else, or another batch works there.
        KeyboardInterrupt: If the user stopped it; what is finished stays.
    """
    folder = BatchFolder(out)
    lock = FolderLock(folder.path)
    try:
        tasks = {flight.name: folder.task(flight, settings) for flight in flights}
        rows = {name: _row_before(folder, task) for name, task in tasks.items()}
        waiting = [task for name, task in tasks.items() if rows[name].state == WAITING]
        if len(waiting) < len(tasks):
            say(f"{len(tasks) - len(waiting)} of {len(tasks)} flights were done before")
        try:
            _work(folder, rows, waiting, runner, say)
        finally:
            _write(folder, list(rows.values()))
    finally:
        lock.release()
    return list(rows.values())


def _work(
    folder: BatchFolder, rows: dict[str, Row], waiting: Sequence[Task], runner: Runner, say: Callable[[str], None]
) -> None:
    written_s = time.monotonic()
    with closing(runner(waiting, folder.prepare)) as ends:
        for done, (task, ended) in enumerate(ends, start=1):
            row = _row_after(folder, task, ended)
            rows[row.name] = row
            say(f"[{done}/{len(waiting)}] {row}")
            if time.monotonic() - written_s > WRITE_EVERY_S:
                _write(folder, list(rows.values()))
                written_s = time.monotonic()


def _row_before(folder: BatchFolder, task: Task) -> Row:
    found = folder.result(task)
    return _row(folder, task, WAITING, "not run yet") if found is None else _row(folder, task, DONE, "", found)


def _row_after(folder: BatchFolder, task: Task, ended: Ended) -> Row:
    found = folder.result(task)
    if found is None:
        return _row(folder, task, FAILED, _short(ended.reason, task.flight), attempts=ended.attempts)
    return _row(folder, task, DONE, "", found, ended.attempts)


def _short(reason: str, flight: Flight) -> str:
    """The reason without what every failure of ours ends with, and without folders that mean nothing elsewhere."""
    short = reason.removesuffix(" (exit code 1)").replace(f"{flight.recording.absolute().parent}{os.sep}", "")
    return short or "left no result"


def _row(
    folder: BatchFolder, task: Task, state: str, reason: str, found: dict[str, Any] | None = None, attempts: int = 1
) -> Row:
    name = task.flight.name
    picture = f"{PICTURES}/{name}.jpg"
    return Row(
        name=name,
        state=state,
        reason=reason,
        recording=str(task.flight.recording),
        folder=f"{FLIGHTS}/{name}" if found is not None else "",
        log=f"{JOBS}/{name}/{LOG}" if state != WAITING else "",
        picture=picture if (folder.path / picture).is_file() else "",
        attempts=attempts,
        figures={} if found is None else found["figures"],
        notes=() if found is None else tuple(found["notes"]),
    )


def _write(folder: BatchFolder, rows: Sequence[Row]) -> None:
    write_tables(folder.path, rows)
    write_page(folder.path, rows)
