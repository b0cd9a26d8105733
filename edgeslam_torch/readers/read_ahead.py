"""Decode the next item while the caller works on this one."""

import queue
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Any, TypeVar

T = TypeVar("T")

_POLL_S = 0.2
"""Interval at which a waiting reader checks whether to stop."""


class _End:
    def __init__(self, error: BaseException | None) -> None:
        self.error = error


def offered(buffer: "queue.Queue[Any]", item: Any, stop: threading.Event) -> bool:
    """Put an item into a queue once there is room; False when told to stop."""
    while not stop.is_set():
        try:
            buffer.put(item, timeout=_POLL_S)
        except queue.Full:
            continue
        return True
    return False


def read_ahead(
    items: Iterator[T], depth: int = 1, offer: "Callable[[queue.Queue[Any], T, threading.Event], bool]" = offered
) -> Generator[T]:
    """The same items in the same order, read by one background thread, at most ``depth`` + 1 items ahead.

    An exception of ``items`` is raised here, after the items that came before it. Closing the generator stops the
    thread.

    Args:
        items: Read in the thread.
        depth: Length of the queue.
        offer: Puts an item into the queue, as `offered` does.
    """
    buffer: queue.Queue[T | _End] = queue.Queue(maxsize=depth)
    stop = threading.Event()

    def fill() -> None:
        error: BaseException | None = None
        try:
            for item in items:
                if not offer(buffer, item, stop):
                    return
        except BaseException as caught:  # passed on: raised in the consumer's thread
            error = caught
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                close()
        offered(buffer, _End(error), stop)

    worker = threading.Thread(target=fill, name="read-ahead", daemon=True)
    worker.start()
    try:
        while not isinstance(item := buffer.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stop.set()
        worker.join()
