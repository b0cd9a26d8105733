"""Decode the next item while the caller works on this one."""

import queue
import threading
from collections.abc import Generator, Iterator
from typing import TypeVar

T = TypeVar("T")

_POLL_S = 0.2
"""Interval at which a waiting reader checks whether to stop."""


class _End:
    def __init__(self, error: BaseException | None) -> None:
        self.error = error


def read_ahead(items: Iterator[T], depth: int = 1) -> Generator[T]:
    """The same items in the same order, read by one background thread, at most ``depth`` + 1 items ahead.

    An exception of ``items`` is raised here, after the items that came before it. Closing the generator stops the
    thread.
    """
    buffer: queue.Queue[T | _End] = queue.Queue(maxsize=depth)
    stop = threading.Event()
    worker = threading.Thread(target=_fill, args=(items, buffer, stop), name="read-ahead", daemon=True)
    worker.start()
    try:
        while True:
            item = buffer.get()
            if isinstance(item, _End):
                if item.error is not None:
                    raise item.error
                return
            yield item
    finally:
        stop.set()
        worker.join()


def _fill(items: Iterator[T], buffer: "queue.Queue[T | _End]", stop: threading.Event) -> None:
    error: BaseException | None = None
    try:
        for item in items:
            if not _offer(buffer, item, stop):
                return
    except BaseException as caught:  # passed on: raised in the consumer's thread
        error = caught
    finally:
        close = getattr(items, "close", None)
        if close is not None:
            close()
    _offer(buffer, _End(error), stop)


def _offer(buffer: "queue.Queue[T | _End]", item: "T | _End", stop: threading.Event) -> bool:
    while not stop.is_set():
        try:
            buffer.put(item, timeout=_POLL_S)
        except queue.Full:
            continue
        return True
    return False
