"""Keyboard control during a flight: space toggles hovering, l or q lands."""

import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LAND, HOLD = b"lLqQ", b" "
_POLL_S = 0.1


@contextmanager
def keys(hold: Callable[[bool], None], land: Callable[[], None]) -> Iterator[bool]:
    """Listen while the block runs; yields whether there is a terminal to listen to.

    Args:
        hold: Called with whether to hover.
        land: Called to land.
    """
    if os.name != "posix" or not sys.stdin.isatty():
        yield False
        return
    import termios
    import tty

    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    stopping = threading.Event()
    thread = threading.Thread(target=listen, args=(number, stopping, hold, land), name="fly-keys", daemon=True)
    try:
        tty.setcbreak(number)  # Ctrl-C still works
        thread.start()
        yield True
    finally:
        stopping.set()
        thread.join(1.0)
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def listen(number: int, stopping: threading.Event, hold: Callable[[bool], None], land: Callable[[], None]) -> None:
    """Read keys from a file descriptor until stopped or end of file."""
    held = False
    while not stopping.is_set():
        if not select.select([number], [], [], _POLL_S)[0]:
            continue
        key = os.read(number, 1)
        if not key:
            return
        if key in HOLD:
            held = not held
            hold(held)
        elif key in LAND:
            land()
