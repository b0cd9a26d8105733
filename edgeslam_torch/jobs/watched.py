"""Work in processes of its own, some at a time: time and memory of each are bounded, and a stop ends all of them."""

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import IO, TypeVar

from edgeslam_torch.files.plain import create

POLL_S = 0.05
"""Time between two looks at a process; what it takes in between is not noticed."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a process that shares the machine with others of its kind."""

Start = Callable[[Path, IO[str]], subprocess.Popen[str]]
"""Starts the process of a folder, which writes to a log."""

T = TypeVar("T")


class How(StrEnum):
    """How a process ended."""

    ITSELF = "itself"
    """With an exit code."""
    KILLED = "killed"
    """By a signal that was not ours: a crash, the system short of memory, somebody's ``kill``."""
    LATE = "late"
    """By us: it took too long."""
    TOO_LARGE = "too large"
    """By us: it took too much memory."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a process may take."""

    timeout_s: float
    memory_mb: float | None = None
    """Resident memory, looked at every `POLL_S`; not bounded when None, or where the system has no ``/proc``."""


@dataclass(frozen=True, slots=True)
class Ended:
    """End of a process."""

    how: How
    reason: str
    """In words; empty when it ended with exit code 0."""
    attempts: int = 1


class Job:
    """A process that is being watched."""

    def __init__(self, folder: Path, log: Path, start: Start, limits: Limits) -> None:
        """Start it.

        Args:
            folder: Handed to ``start``.
            log: File for its output; an older one is replaced.
            start: Starts the process.
            limits: What it may take.

        Raises:
            OSError: If the log or the process cannot be made.
        """
        self._log_path = log
        self._log = io.TextIOWrapper(create(log), encoding="utf-8", write_through=True)
        self._limits = limits
        self._begun_s = time.monotonic()
        try:
            self._process = start(folder, self._log)
        except BaseException:
            self._log.close()
            raise

    def ended(self) -> Ended | None:
        """How it ended; None while it runs within its limits."""
        code = self._process.poll()
        if code is None:
            broken = self._broken_limit()
            if broken is None:
                return None
            self.kill()
            return Ended(*broken)
        self.kill()
        how = How.KILLED if code < 0 else How.ITSELF
        return Ended(how, last_words(self._log_path, code) if code else "")

    def kill(self) -> None:
        """End it, and what it started; may be called again."""
        process = self._process
        if process.poll() is None:
            if os.name == "posix" and os.getpgid(process.pid) == process.pid:
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()
        self._log.close()

    def _broken_limit(self) -> tuple[How, str] | None:
        limits = self._limits
        if time.monotonic() - self._begun_s > limits.timeout_s:
            return How.LATE, f"took longer than {limits.timeout_s:.0f} s"
        if limits.memory_mb is not None and (resident_mb(self._process.pid) or 0.0) > limits.memory_mb:
            return How.TOO_LARGE, f"took more than {limits.memory_mb:.0f} MB of memory"
        return None


def run_each(items: Iterable[T], start: Callable[[T], Job], jobs: int, retries: int = 0) -> Generator[tuple[T, Ended]]:
    """Items with the ends of their processes, as they come.

    Whoever stops listening (close the generator) ends the processes that still run.

    Args:
        items: Taken in their order.
        start: Starts an item's process.
        jobs: Processes at a time.
        retries: How often a process that was killed by somebody else is started again.
    """
    waiting = deque((item, 1) for item in items)
    running: list[tuple[T, int, Job]] = []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                item, attempt = waiting.popleft()
                running.append((item, attempt, start(item)))
            time.sleep(POLL_S)
            for entry in list(running):
                item, attempt, job = entry
                ended = job.ended()
                if ended is None:
                    continue
                running.remove(entry)
                if ended.how is How.KILLED and attempt <= retries:
                    waiting.appendleft((item, attempt + 1))
                else:
                    yield item, replace(ended, attempts=attempt)
    finally:  # an interrupted caller leaves no process behind
        for _, _, job in running:
            job.kill()


def start_module(
    module: str, folder: Path, log: IO[str], environment: Mapping[str, str] = ONE_THREAD
) -> subprocess.Popen[str]:
    """A module of ours that works on a folder, out of reach of the terminal's Ctrl-C; on one thread by default.

    It may call `end_with_parent`, which ends it when this process dies.
    """
    return subprocess.Popen(
        [sys.executable, "-m", module, str(folder)],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        text=True,
        env={**os.environ, **environment},
        start_new_session=os.name == "posix",
    )


def end_with_parent() -> None:
    """End this process at once when the one that started it has died, however that died.

    The parent holds the other end of stdin and never writes: its end is the only thing to be read there.
    """

    stdin = sys.stdin.fileno()

    def wait() -> None:
        os.read(stdin, 1)  # not sys.stdin, whose lock would abort the interpreter's shutdown
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def last_words(log: Path, code: int) -> str:
    """Last line of a process's output, and how it ended."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    ended = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
    return f"{lines[-1].strip()} ({ended})" if lines else ended


def resident_mb(process: int) -> float | None:
    """Resident memory of a process [MB]; None where the system does not report it."""
    try:
        with open(f"/proc/{process}/statm", encoding="ascii") as file:
            pages = int(file.read().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
