"""Runs the flights of a batch that have no result yet, and keeps one table and one page of all."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.experiment.runner import LOG, Runner, run_tasks
from edgeslam_torch.fleet.folder import FLIGHTS, JOBS, PICTURES, BatchFolder, BatchSettings, FlightTask
from edgeslam_torch.fleet.manifest import Flight
from edgeslam_torch.fleet.page import write_page
from edgeslam_torch.fleet.table import DONE, FAILED, WAITING, Row, write_tables
from edgeslam_torch.writers.own_folder import FolderLock

WRITE_EVERY_S = 5.0
"""Table and page are written again after this time, and at the end."""


def run_batch(
    flights: Sequence[Flight], settings: BatchSettings, out: Path, runner: Runner, say: Callable[[str], None]
) -> list[Row]:
    """Run what has no result in ``out``; table and page there are of all flights, also after an interrupt.

    Args:
        flights: With different names.
        settings: How.
        out: The batch's folder; one batch at a time.
        runner: `Local`, or one of a cluster.
        say: Receives one line for every flight that ended.

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
        tasks = {flight: folder.task(flight, settings) for flight in flights}
        rows = {flight: _row(folder, flight, WAITING, "not run yet") for flight in flights}
        try:
            _work(folder, rows, tasks, runner, say)
        finally:
            _write(folder, list(rows.values()))
    finally:
        lock.release()
    return list(rows.values())


def _work(
    folder: BatchFolder,
    rows: dict[Flight, Row],
    tasks: Mapping[Flight, FlightTask],
    runner: Runner,
    say: Callable[[str], None],
) -> None:
    waiting = {flight: task for flight, task in tasks.items() if task.result() is None}
    if len(waiting) < len(tasks):
        say(f"{len(tasks) - len(waiting)} of {len(tasks)} flights were done before")
    written_s, done = time.monotonic(), 0
    for flight, found, ended in run_tasks(tasks, runner):
        reason = "" if found is not None or ended is None else _short(ended.reason, flight)
        attempts = 1 if ended is None else ended.attempts
        rows[flight] = _row(folder, flight, FAILED if found is None else DONE, reason, found, attempts)
        if ended is None:
            continue
        done += 1
        say(f"[{done}/{len(waiting)}] {rows[flight]}")
        if time.monotonic() - written_s > WRITE_EVERY_S:
            _write(folder, list(rows.values()))
            written_s = time.monotonic()


def _short(reason: str, flight: Flight) -> str:
    """The reason without what every failure of ours ends with, and without folders that mean nothing elsewhere."""
    short = reason.removesuffix(" (exit code 1)").replace(f"{flight.recording.absolute().parent}{os.sep}", "")
    return short or "left no result"


def _row(
    folder: BatchFolder, flight: Flight, state: str, reason: str, found: dict[str, Any] | None = None, attempts: int = 1
) -> Row:
    name = flight.name
    picture = f"{PICTURES}/{name}.jpg"
    return Row(
        name=name,
        state=state,
        reason=reason,
        recording=str(flight.recording),
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
