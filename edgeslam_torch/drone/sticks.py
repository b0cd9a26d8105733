"""The sticks of a drone with a dead-man's switch."""

import threading
import time
from collections.abc import Callable

FRESH_S = 0.3
"""Maximum age of an ``rc`` command."""
_TICK_S = 0.05
_AGAIN_S = 0.1
"""Interval at which centred sticks are repeated: ``rc`` is not acknowledged and packets may be lost."""
CENTRED = "rc 0 0 0 0"


class Sticks:
    """Forwards ``rc`` commands, and centres the sticks when no fresh one arrives.

    Args:
        transmit: Sends a command; never blocks, never raises.
        on_tick: Called every 50 ms with whether the sticks are pushed.
    """

    def __init__(self, transmit: Callable[[str], None], on_tick: Callable[[bool], None]) -> None:
        self._transmit, self._on_tick = transmit, on_tick
        self._lock = threading.Lock()
        self._pushed_s: float | None = None
        """Time of the last ``rc``; None while the sticks are released."""
        self._centred_s: float | None = None
        """Time at which they were centred last; None while deflected."""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tello-sticks", daemon=True)
        self._thread.start()

    def push(self, command: str, allowed: Callable[[], None]) -> None:
        """Send an ``rc`` command unless ``allowed`` raises, atomically."""
        with self._lock:
            allowed()
            self._pushed_s, self._centred_s = time.monotonic(), None
            self._transmit(command)

    def let_go(self) -> None:
        """Centre the sticks if deflected, and stop repeating."""
        with self._lock:
            if self._pushed_s is not None:
                self._transmit(CENTRED)
            self._pushed_s = self._centred_s = None

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join(timeout=1.0)

    def _work(self) -> None:
        while not self._stopping.wait(_TICK_S):
            with self._lock:
                self._centre_if_stale(time.monotonic())
                pushed = self._pushed_s is not None and self._centred_s is None
            self._on_tick(pushed)

    def _centre_if_stale(self, now: float) -> None:
        if self._pushed_s is None or now - self._pushed_s < FRESH_S:
            return
        if self._centred_s is None or now - self._centred_s >= _AGAIN_S:
            self._transmit(CENTRED)
            self._centred_s = now
