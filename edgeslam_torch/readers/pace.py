"""Playback of a recording at its original rate."""

import queue
import threading
import time
from collections.abc import Iterator

from edgeslam_torch.types import Frame

REALTIME_QUEUE = 15
"""Frames that may wait for a slow step, half a second at 30 a second.

The step that starts the map takes 0.3 s on a PC; tracking a frame takes a third of the time between two, so that what
waited is soon caught up with.
"""


class Counter:
    """A counter shared with the feeding thread."""

    def __init__(self) -> None:
        self.value = 0


def at_their_pace(frames: Iterator[Frame], dropped: Counter, waiting: int = REALTIME_QUEUE) -> Iterator[Frame]:
    """Frames of a recording as from a camera: at their stamps; when the queue is full the oldest is dropped.

    Args:
        frames: Of a recording.
        dropped: Counts dropped frames.
        waiting: Length of the queue.
    """
    buffer: queue.Queue[Frame | None] = queue.Queue()
    stop = threading.Event()
    failure: list[BaseException] = []

    def feed() -> None:
        begin_wall, begin_stamp = time.monotonic(), None
        try:
            for frame in frames:
                begin_stamp = frame.stamp_s if begin_stamp is None else begin_stamp
                due_s = begin_wall + frame.stamp_s - begin_stamp
                if stop.wait(max(0.0, due_s - time.monotonic())):
                    return
                while buffer.qsize() >= waiting:
                    try:
                        buffer.get_nowait()
                    except queue.Empty:
                        break
                    dropped.value += 1
                buffer.put(frame)
        except BaseException as error:  # passed on: raised in the consumer's thread
            failure.append(error)
        finally:
            buffer.put(None)

    worker = threading.Thread(target=feed, name="camera-pace", daemon=True)
    worker.start()
    try:
        while (frame := buffer.get()) is not None:
            yield frame
        if failure:
            raise failure[0]
    finally:
        stop.set()
        worker.join()
        close = getattr(frames, "close", None)
        if close is not None:
            close()
