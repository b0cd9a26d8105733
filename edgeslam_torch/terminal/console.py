"""`console`: standard output and error of a command, which no name and no closed pipe can break.

File names, topics and ONNX metadata come from anybody: their control characters would move the cursor or set the
terminal's title. And a pipe that its reader has closed, a full disk behind ``>``, or a terminal that cannot show a
letter must not end a run whose results go to a folder.
"""

import errno
import os
import sys
import threading
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

EXIT_HUNG_UP = 129
_CONTROL = {
    code: "\N{REPLACEMENT CHARACTER}"
    for code in (*range(0x20), *range(0x7F, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A))
    if chr(code) not in "\r\n\t"
}
"""C0 and C1 controls, and marks that turn the direction of writing."""
_COLUMNS = 80
"""Width assumed for a terminal that reports none, or 0."""
_MOMENT_S = 0.5
"""Longest wait for another thread's line: a terminal may be stopped (Ctrl-S), and a drone must land nevertheless."""


class Console:
    """A text stream that drops what cannot be printed, and remembers why; its last line may be a status."""

    def __init__(self, stream: TextIO | None, below: "Console | None" = None) -> None:
        """``stream`` is None when the descriptor was closed before the program began (``2>&-``); ``below`` is the
        stream whose status stands below what this one prints, itself by default."""
        self._stream = stream
        self.error: OSError | None = None
        """Why nothing more is printed."""
        self._below = below or self
        self._lock = threading.RLock()
        self._status = ""
        """What `show` has put on the terminal's last line."""
        self._line_ended = True

    def write(self, text: str) -> int:
        """Print without control characters, above the status."""
        below = self._below
        with below._alone():
            if text and self.isatty():
                below._replace_status("")
                below._line_ended = text.endswith("\n")
            self._print(text)
        return len(text)

    def show(self, status: str) -> None:
        """Replace the status on the terminal's last line; an empty one takes it away."""
        with self._alone():
            if self._line_ended:
                self._replace_status(_cut(status.translate(_CONTROL).replace("\n", " "), self._columns() - 1))
                self.flush()

    def _replace_status(self, status: str) -> None:
        if status or self._status:
            blanks = " " * max(0, _width(self._status) - _width(status))
            self._print(f"\r{status}{blanks}" + ("" if status else "\r"))
        self._status = status

    @contextmanager
    def _alone(self) -> Iterator[None]:
        got = self._lock.acquire(timeout=_MOMENT_S)
        try:
            yield
        finally:
            if got:
                self._lock.release()

    def _columns(self) -> int:
        try:
            return os.get_terminal_size(self.fileno()).columns or _COLUMNS
        except (OSError, ValueError, AttributeError):
            return _COLUMNS

    def _print(self, text: str) -> None:
        stream = self._stream
        if stream is not None and self.error is None:
            shown = text.translate(_CONTROL)
            try:
                try:
                    stream.write(shown)
                except UnicodeEncodeError:
                    stream.write(shown.encode(stream.encoding, "replace").decode(stream.encoding))
            except OSError as error:
                self._give_up(error)

    def flush(self) -> None:
        """Print what waits."""
        if self._stream is not None and self.error is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def isatty(self) -> bool:
        """Whether a person watches."""
        return self._stream is not None and self._stream.isatty()

    def _give_up(self, error: OSError) -> None:
        """The text that waits in the buffer goes nowhere: Python would try again, and complain, at its end."""
        self.error = error
        with suppress(OSError, ValueError, AttributeError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())  # type: ignore[union-attr]
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _width(text: str) -> int:
    """Columns that it takes on a terminal."""
    return sum(2 if unicodedata.east_asian_width(c) in "FW" else 1 for c in text)


def _cut(text: str, columns: int) -> str:
    while _width(text) > columns:
        text = text[:-1]
    return text


@contextmanager
def console() -> Iterator[tuple[Console, Console]]:
    """Standard output and error as `Console` while a command runs."""
    before = sys.stdout, sys.stderr
    err = Console(before[1])
    out = Console(before[0], err)
    sys.stdout, sys.stderr = out, err
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def exit_code(code: int, out: Console, err: Console) -> int:
    """The command's exit code, unless what it printed is lost for another reason than a reader that had enough."""
    for stream in (out, err):
        if stream.error is not None and stream.error.errno == errno.EIO:
            return EXIT_HUNG_UP  # the terminal was closed; results are on disk
    if code == 0 and out.error is not None and out.error.errno not in (errno.EPIPE, errno.EBADF):
        err.write(f"edgeslam: error: cannot print: {out.error.strerror or out.error}\n")
        return 1
    return code
