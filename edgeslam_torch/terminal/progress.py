"""Progress of long work: the last line of a terminal, redrawn twice a second; elsewhere a line every few seconds."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from types import TracebackType
from typing import Self, TextIO, TypeVar

from edgeslam_torch.terminal.console import Console

T = TypeVar("T")

SHOWN_EVERY_S = 0.5
LINE_EVERY_S = 5.0
_LONGEST_JOIN_S = 1.0
"""A thread that writes to a stopped terminal is not waited for."""
_LEAST_RATE = 0.1
"""[1/s]; for slower work only the remaining time is shown."""

_open: "list[Progress]" = []
"""Nested work: the innermost is shown."""


class Progress:
    """One piece of work and its phases, shown on stderr by a thread of its own: also while the work waits.

    Args:
        what: Name of the work or of its first phase, such as "training".
        total: Expected count; None if unknown.
        unit: What is counted, such as "frame"; if empty, the elapsed time is shown.
        done: Counted before, by another process; not part of the rate.
        shown: Whether to show anything; of several processes one does.
        redraw: Whether the output can redraw a line; whether it is a terminal by default.
        stream: Where to show it; stderr when None.
        clock: Clock [s].

    Example:
        >>> with Progress("rendering", 20, "image") as progress:
        ...     for _ in range(20):
        ...         progress.advance()
    """

    def __init__(
        self,
        what: str,
        total: int | None = None,
        unit: str = "",
        done: float = 0,
        *,
        shown: bool = True,
        redraw: bool | None = None,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        stream = stream if stream is not None else sys.stderr
        self._console = stream if isinstance(stream, Console) else Console(stream)
        self._redraw = self._console.isatty() if redraw is None else redraw
        self._clock = clock
        self.words: Callable[[], str] = str
        """Further text, evaluated whenever the line is shown; none by default."""
        self._printed_s, self._printed = clock(), ""
        self._begin(what, total, unit, done)
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        if shown:
            _open.append(self)
            self._thread = threading.Thread(target=self._keep_showing, name="progress", daemon=True)
            self._thread.start()

    def phase(self, what: str, total: int | None = None, unit: str = "") -> None:
        """Begin another part of the work, with a count of its own."""
        self.show()
        self._begin(what, total, unit, 0)

    def advance(self, by: float = 1) -> None:
        """Add to the count."""
        self._done += by

    def reach(self, done: float, total: float | None) -> None:
        """Set the count and the total."""
        self._done, self._total = done, total

    def downloaded(self, have: int, total: int) -> None:
        """The same in bytes, of a total that may be 0 for unknown; the unit is MB."""
        self.reach(have / 1e6, total / 1e6 or None)

    def text(self) -> str:
        """The line: name, count, rate, time left, and `words`."""
        taken_s = self._clock() - self._since_s
        parts = [self._what] if self._what else []
        if self._unit:
            units = self._unit if self._unit == "MB" else f"{self._unit}s"
            counted = self._unit if max(self._done, self._total or 0) == 1 else units
            number = ".1f" if self._unit == "MB" else ".0f"
            of = "" if self._total is None else f" of {self._total:{number}}"
            parts += [f"{self._done:{number}}{of} {counted}"]
            rate = (self._done - self._first) / taken_s if taken_s > 0 else 0.0
            parts += [f"{rate:.1f} {units}/s"] if rate >= _LEAST_RATE else self._taken(taken_s)
            parts += (
                [f"{_time((self._total - self._done) / rate)} left"] if self._total is not None and rate > 0 else []
            )
        else:
            parts += self._taken(taken_s)
        return ", ".join(part for part in (*parts, self.words()) if part)

    def _taken(self, taken_s: float) -> list[str]:
        """Elapsed time, where the line can be redrawn: lines that differ in nothing else are not repeated."""
        return [_time(taken_s)] if self._redraw else []

    def show(self) -> None:
        """Show the progress if an update is due; called by the thread."""
        if self._thread is None or _open[-1:] != [self]:
            return
        if self._redraw:
            self._console.show(f"edgeslam: {self.text()}")
        elif (now := self._clock()) - self._printed_s >= LINE_EVERY_S and (text := self.text()) != self._printed:
            self._printed_s, self._printed = now, text
            self._console.write(f"edgeslam: {text}\n")
            self._console.flush()

    def close(self) -> None:
        """Remove the line and stop the thread."""
        if self._thread is None or self._ended.is_set():
            return
        self._ended.set()
        self._thread.join(_LONGEST_JOIN_S)
        if not self._redraw:
            self.show()
        _open.remove(self)
        if self._redraw:
            self._console.show("")

    def _begin(self, what: str, total: float | None, unit: str, done: float) -> None:
        self._what, self._total, self._unit = what, total, unit
        self._done = self._first = done
        self._since_s = self._clock()

    def _keep_showing(self) -> None:
        while not self._ended.wait(SHOWN_EVERY_S):
            self.show()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def counted(items: Iterable[T], what: str, unit: str, total: int | None = None, shown: bool = True) -> Iterator[T]:
    """The items, with progress."""
    known = len(items) if total is None and isinstance(items, Sized) else total
    with Progress(what, known, unit, shown=shown) as progress:
        for item in items:
            yield item
            progress.advance()


def _time(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
