"""`console`: standard output and error of a command, which no name and no closed pipe can break.

File names, topics and ONNX metadata come from anybody: their control characters would move the cursor or set the
terminal's title. And a pipe that its reader has closed, a full disk behind ``>``, or a terminal that cannot show a
letter must not end a run whose results go to a folder.
"""

import errno
import os
import sys
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
_OF_PROGRESS_BARS = ("\x1b[A", "\x1b[K")
"""One line up, clear the line: tqdm sends them alone."""


class Console:
    """A text stream that drops what cannot be printed, and remembers why."""

    def __init__(self, stream: TextIO | None) -> None:
        """``stream``: None when the descriptor was closed before the program began (``2>&-``)."""
        self._stream = stream
        self.error: OSError | None = None
        """Why nothing more is printed."""

    def write(self, text: str) -> int:
        """Print without control characters."""
        stream = self._stream
        if stream is not None and self.error is None:
            shown = text if text in _OF_PROGRESS_BARS else text.translate(_CONTROL)
            try:
                try:
                    stream.write(shown)
                except UnicodeEncodeError:
                    stream.write(shown.encode(stream.encoding, "replace").decode(stream.encoding))
            except OSError as error:
                self._give_up(error)
        return len(text)

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


@contextmanager
def console() -> Iterator[tuple[Console, Console]]:
    """Standard output and error as `Console` while a command runs."""
    before = sys.stdout, sys.stderr
    out, err = Console(before[0]), Console(before[1])
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
