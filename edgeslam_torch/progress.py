"""Progress of a run: a bar on a terminal, a line every few seconds elsewhere."""

import sys
import time
from types import TracebackType
from typing import Protocol, TextIO

from edgeslam_torch.types import Frame, SlamOutput

LINE_EVERY_S = 5.0


class Progress(Protocol):
    """A listener of `edgeslam_torch.run.run` that shows progress."""

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Called after each frame."""

    def on_finish(self, slam: object) -> None:
        """Called after the last refinement."""

    def __enter__(self) -> "Progress":
        """Start showing."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop showing."""


def make_progress(total: int | None, show_bar: bool, stream: TextIO | None = None) -> Progress:
    """A bar or lines, on stderr unless told otherwise.

    Args:
        total: Expected number of frames; None if unknown.
        show_bar: Whether the output is a terminal that can redraw a line.
        stream: Where to show it.
    """
    stream = stream if stream is not None else sys.stderr
    return ProgressBar(total, stream) if show_bar else ProgressLines(total, stream)


class ProgressBar:
    """A tqdm bar with frames per second, time left and the last frame's status."""

    def __init__(self, total: int | None, stream: TextIO) -> None:
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit="frame", file=stream, dynamic_ncols=True, smoothing=0.1)

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Advance by one; the text is redrawn with the bar only."""
        if self._bar.n == 0:
            self._bar.unpause()  # loading the network is not part of the rate
        self._bar.set_postfix_str(status_words(output), refresh=False)
        self._bar.update()

    def on_finish(self, slam: object) -> None:
        """Nothing to show."""

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()


class ProgressLines:
    """A line every few seconds, for log files."""

    def __init__(self, total: int | None, stream: TextIO) -> None:
        self._total = total
        self._stream = stream
        self._done = 0
        self._begin = self._shown = 0.0

    def on_frame(self, frame: Frame, output: SlamOutput, slam: object) -> None:
        """Count, and print a line when due."""
        now = time.monotonic()
        if self._done == 0:  # loading the network is not part of the rate
            self._begin = self._shown = now
        self._done += 1
        if now - self._shown < LINE_EVERY_S:
            return
        self._shown = now
        rate = self._done / max(now - self._begin, 1e-9)
        of = f"/{self._total}" if self._total is not None else ""
        left = f", {(self._total - self._done) / rate:.0f} s left" if self._total is not None else ""
        text = f"{self._done}{of} frames, {rate:.1f} frames/s{left}, {status_words(output)}"
        self._stream.write(f"edgeslam: {text}\n")
        self._stream.flush()

    def on_finish(self, slam: object) -> None:
        """Nothing more to show."""

    def __enter__(self) -> "ProgressLines":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to close."""


def status_words(output: SlamOutput) -> str:
    """Status of one frame with its reason and the uncertainty of its metres, short."""
    reason = f" ({output.reason})" if output.reason else ""
    health = "" if output.health is None else f", {output.health}"
    return f"{output.status}{reason}, {output.inliers} inliers{health}"
