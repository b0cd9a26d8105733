"""Cases, each in a process of its own: a failure costs one case, and what has a result is not run again.

A case's folder holds ``case.json`` (what to do), ``log.txt`` and ``result.json``. Its process imports the function that
``case.json`` names and stores what it returns::

    python -m edgeslam_torch.eval.experiment.runner FOLDER
"""

import importlib
import json
import os
import sys
from collections.abc import Callable, Collection, Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.files.record_files import is_record, read_mapping
from edgeslam_torch.jobs.watched import Ended, Job, Limits, Start, end_with_parent, run_each, start_module
from edgeslam_torch.writers.own_folder import check_free

MODULE = "edgeslam_torch.eval.experiment.runner"
CASE, RESULT, LOG = "case.json", "result.json", "log.txt"
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Task:
    """A case to run."""

    place: Path
    """Folder of the cases' folders."""
    name: str
    """Of its folder."""
    run: str
    """``module:function`` of the content of ``case.json`` and the case's folder; returns a JSON object."""
    case: Mapping[str, Any]
    """Everything that determines the result."""
    beside: Mapping[str, Any] = field(default_factory=dict)
    """Further content that does not."""

    @property
    def folder(self) -> Path:
        """Of the case."""
        return self.place / self.name

    @property
    def key(self) -> str:
        """Changes with everything that determines the result."""
        return json.dumps([self.run, self.case], sort_keys=True)

    def result(self) -> dict[str, Any] | None:
        """The stored result of this very case."""
        try:
            found = read_mapping(self.folder / RESULT, "JSON", EvaluationError)
        except EvaluationError:
            return None
        return found if found.pop("key", None) == self.key else None

    def prepare(self) -> Path:
        """The folder, with what the process has to do and no result."""
        folder = subfolder(self.place.parent, self.place.name, self.name)
        (folder / RESULT).unlink(missing_ok=True)
        content = {"key": self.key, "run": self.run, **self.beside, **self.case}
        write_text(folder / CASE, json.dumps(content, indent=1) + "\n")
        return folder


def check_own(out: Path, cases: str, keys: Collection[str] = (), *names: str) -> None:
    """Check that an experiment may write its cases' folder and ``names`` into ``out``; what marks such a folder as its
    own is the first of them, a record with ``keys``, or while there is none its cases.

    Raises:
        OutputError: If it would replace what no such experiment wrote.
    """

    def is_ours(folder: Path) -> bool:
        if keys and os.path.lexists(folder / names[0]):
            return is_record(folder / names[0], keys)
        return any(is_record(case, ("key", "run")) for case in (folder / cases).glob(f"*/{CASE}"))

    check_free(out, (*names, cases), is_ours)


Runner = Callable[[Iterable[Any], Callable[[Any], Path]], Generator[tuple[Any, Ended]]]
"""Runs cases, whose folders the second argument makes, here or elsewhere: cases with the ends of their processes, as
they come; closing it ends what still runs."""


@dataclass(frozen=True, slots=True)
class Local:
    """Runs cases on this machine, each in a process of its own on one thread."""

    processes: int
    limits: Limits
    retries: int = 0
    """Repetitions after a process was killed from outside."""
    start: Start = partial(start_module, MODULE)

    def __call__(self, cases: Iterable[T], prepare: Callable[[T], Path]) -> Generator[tuple[T, Ended]]:
        """See `Runner`."""
        return run_each(cases, lambda case: self.job(prepare(case)), self.processes, self.retries)

    def job(self, folder: Path) -> Job:
        """The watched process of a case's folder."""
        return Job(folder, folder / LOG, self.start, self.limits)


def run_tasks(tasks: Mapping[T, Task], runner: Runner) -> Generator[tuple[T, dict[str, Any] | None, Ended | None]]:
    """Each case with its result and the end of its process: stored results first, without an end, then as they come.

    The result is None for a case that failed.
    """
    waiting = []
    for case, task in tasks.items():
        found = task.result()
        if found is None:
            waiting.append(case)
        else:
            yield case, found, None
    with closing(runner(waiting, lambda case: tasks[case].prepare())) as ends:
        for case, ended in ends:
            yield case, tasks[case].result(), ended


def run_all(
    tasks: Mapping[T, Task],
    runner: Runner,
    row: Callable[[T, dict[str, Any] | None, str], R],
    line: Callable[[T, R], str],
    say: Callable[[str], None],
) -> dict[T, R]:
    """A row for each case, of its result or of the reason why there is none; a line is said for those run now."""
    rows: dict[T, R] = {}
    for case, found, ended in run_tasks(tasks, runner):
        rows[case] = row(case, found, ended.reason if found is None and ended is not None else "")
        if ended is not None:
            say(f"[{len(rows)}/{len(tasks)}] {line(case, rows[case])}")
    return rows


def main(folder: Path) -> int:
    """Run the case of a folder; on failure the last line on stderr gives the reason."""
    case: dict[str, Any] = json.loads((folder / CASE).read_text(encoding="utf-8"))
    module, _, name = case["run"].partition(":")
    try:
        found = getattr(importlib.import_module(module), name)(case, folder)
    except EdgeSlamError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    write_text(folder / RESULT, json.dumps({"key": case["key"]} | found, indent=1, default=float) + "\n")
    return 0


if __name__ == "__main__":
    end_with_parent()
    sys.exit(main(Path(sys.argv[1])))
