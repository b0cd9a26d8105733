"""Progress of long work: a bar on a terminal, a line every few seconds elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TextIO, TypeVar

from tqdm import tqdm

from edgeslam_torch.progress import LINE_EVERY_S
from edgeslam_torch.train.processes.distributed import rank

T = TypeVar("T")


class Count:
    """Counts towards a total; only the first process of a group shows anything.

    Args:
        total: Total count.
        what: Name of the work, such as "training".
        unit: What is counted.
        done: Count done before by another process; not part of the rate.
        stream: Where to show it; stderr when None.
        clock: Clock [s].
    """

    def __init__(
        self,
        total: int,
        what: str,
        unit: str,
        done: int = 0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        stream = stream if stream is not None else sys.stderr
        self._total, self._what, self._unit, self._done = total, what, unit, done
        self._stream = stream if rank() == 0 else None
        self._clock, self._first, self._begin = clock, done, clock()
        self._shown = self._begin
        self._bar: tqdm | None = None
        if self._stream is not None and stream.isatty():
            self._bar = tqdm(
                total=total, initial=done, desc=what, unit=unit, file=stream, dynamic_ncols=True, leave=False
            )

    def advance(self, text: str = "") -> None:
        """Count one item.

        Args:
            text: Text shown with the count.
        """
        self._done += 1
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update()
        elif self._stream is not None and self._clock() - self._shown >= LINE_EVERY_S:
            self._line(text)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()

    def _line(self, text: str) -> None:
        assert self._stream is not None
        self._shown = self._clock()
        left = (self._total - self._done) * (self._shown - self._begin) / (self._done - self._first)
        words = f"{self._what}: {self._unit} {self._done} of {self._total}, {left:.0f} s left"
        self._stream.write(f"edgeslam: {words}{', ' if text else ''}{text}\n")
        self._stream.flush()


def counted(items: Sequence[T], what: str, unit: str) -> Iterator[T]:
    """The items, with progress on stderr."""
    count = Count(len(items), what, unit)
    try:
        for item in items:
            yield item
            count.advance()
    finally:
        count.close()
