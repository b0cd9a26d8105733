"""Ends of a flight or a recording by signals: in order, with what was reached said and kept."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


class Signals:
    """Ctrl-C, ``kill``, a closed terminal: each ends the recording, none interrupts a landing.

    Signals that are ignored already (``nohup``) stay ignored.
    """

    def __init__(self) -> None:
        self.number = 0
        """First signal received."""
        self._end: Callable[[], None] | None = None
        self._patient = False
        self._old: dict[int, Any] = {}

    @property
    def name(self) -> str:
        """Of the first signal; empty without one."""
        return signal.Signals(self.number).name if self.number else ""

    @property
    def exit_code(self) -> int:
        """Exit code as for a program ended by a signal; 0 without a signal."""
        return 128 + self.number if self.number else 0

    def tell(self, end: Callable[[], None] | None, patient: bool) -> None:
        """Call ``end`` on a signal instead of interrupting: every time if ``patient``, else once; None interrupts."""
        self._end, self._patient = end, patient

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK"):  # no platform has all of them
                number = getattr(signal, name, None)
                if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                    self._old[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *unused: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        again, self.number = self.number != 0, self.number or number
        if self._end is None or (again and not self._patient):
            raise KeyboardInterrupt
        self._end()


def say(text: str) -> None:
    """Print a line at once, and whole: another thread may print, too."""
    print(f"{text}\n", end="", flush=True)
