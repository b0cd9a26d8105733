"""A Tello's H.264 stream: datagrams in, the newest decoded picture with its arrival time out."""

import importlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from edgeslam_torch.drone.udp import Inlet, told
from edgeslam_torch.errors import SourceError
from edgeslam_torch.extras import needs_extra

CHUNK = 1460
"""Bytes of a full datagram; a shorter one ends a picture."""
_MAX_PICTURE = 4 * 1024 * 1024
_RECEIVE_BUFFER = 4 * 1024 * 1024
_OTHER_SIZE_S = 2.0
"""Pictures of another size for this time are another camera; fewer are left out."""


def import_av() -> Any:
    """Import PyAV.

    Raises:
        MissingPackageError: If it is not installed.
    """
    with needs_extra("drone", "video of a drone"):
        av = importlib.import_module("av")
    av.logging.set_level(None)  # a lossy stream would flood the terminal with decoder messages
    return av


class ArrivalClock:
    """Seconds since 1970 that never jump: wall time at the start plus a monotonic clock.

    Whole microseconds, as in recordings, so that a replay has the same stamps.
    """

    def __init__(self) -> None:
        self._offset = time.time() - time.monotonic()

    def now(self) -> float:
        """Now [s]."""
        return round(time.monotonic() + self._offset, 6)


@dataclass(frozen=True, slots=True)
class Picture:
    """One decoded picture."""

    stamp_s: float
    """Arrival of its last datagram."""
    image: np.ndarray
    """``(H, W, 3)`` BGR."""
    count: int
    """Pictures decoded so far, this one included."""


class OneSize:
    """Pictures of one size, that of the calibration: odd ones are left out, and the end is a camera that has changed.

    Args:
        size: Width and height [px].
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.odd = 0
        """Pictures of another size so far."""
        self._odd_since_s: float | None = None

    def fits(self, picture: Picture) -> bool:
        """Whether a picture has the size.

        Raises:
            SourceError: If pictures of another size have come for `_OTHER_SIZE_S`.
        """
        size = (picture.image.shape[1], picture.image.shape[0])
        if size == self.size:
            self._odd_since_s = None
            return True
        self.odd += 1
        if self._odd_since_s is None:
            self._odd_since_s = picture.stamp_s
        if picture.stamp_s - self._odd_since_s < _OTHER_SIZE_S:
            return False
        now, before = ("{}x{}".format(*s) for s in (size, self.size))
        raise SourceError(
            f"pictures are {now} now and were {before}: the resolution was changed in mid-stream; start again, "
            f"with a calibration for {now}"
        )


class PictureAssembler:
    """Datagrams to pictures. Handles a start in mid-stream, lost datagrams and garbage; never raises for bad data."""

    def __init__(self) -> None:
        av = import_av()
        self._av = av
        self._errors: tuple[type[BaseException], ...] = (av.error.FFmpegError, ValueError)
        self._context = av.CodecContext.create("h264", "r")
        self._context.thread_count = 1  # frame threads would delay pictures
        self._context.options = {"flags": "low_delay"}
        self._buffer = bytearray()
        self.decoded = 0
        self.undecodable = 0
        """Pictures lost to missing datagrams or before the first keyframe."""

    def feed(self, datagram: bytes, stamp_s: float) -> list[Picture]:
        """Pictures completed by one datagram; usually none or one."""
        self._buffer += datagram
        if len(datagram) == CHUNK and len(self._buffer) < _MAX_PICTURE:
            return []
        data, self._buffer = bytes(self._buffer), bytearray()
        try:
            frames = self._context.decode(self._av.Packet(data))
            images = [np.asarray(frame.to_ndarray(format="bgr24")) for frame in frames if not frame.is_corrupt]
        except self._errors:
            images = []
        self.undecodable += not images
        pictures = []
        for image in images:
            self.decoded += 1
            pictures.append(Picture(stamp_s, image, self.decoded))
        return pictures


class VideoReceiver:
    """Socket and decoder in a thread; `newest` is the last whole picture.

    Args:
        bind: Where to listen.
        clock: For the stamps.
        host: Numeric address of the drone; packets of other senders are ignored.
        on_picture: Called for each picture, from the video thread.

    Raises:
        MissingPackageError: If PyAV is missing.
        SourceError: If the port is taken.
    """

    def __init__(
        self,
        bind: tuple[str, int],
        clock: ArrivalClock,
        host: str,
        on_picture: Callable[[Picture], None] | None = None,
    ) -> None:
        self._assembler = PictureAssembler()
        self._clock, self._on_picture = clock, on_picture
        self._inlet = Inlet(bind, "video", host, _RECEIVE_BUFFER)
        self._ready = threading.Condition()
        self.newest: Picture | None = None
        """The last whole picture; None before the first."""
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="tello-video", daemon=True)
        self._thread.start()

    @property
    def undecodable(self) -> int:
        """Pictures lost to missing datagrams or before the first keyframe."""
        return self._assembler.undecodable

    @property
    def refused(self) -> int:
        """Packets that did not come from the drone."""
        return self._inlet.refused

    def wait(self, after_count: int, timeout_s: float) -> Picture | None:
        """The newest picture after ``after_count``; None after the timeout."""
        with self._ready:
            self._ready.wait_for(lambda: self._stopping or self._later(after_count), timeout_s)
            return self.newest if self._later(after_count) else None

    def _later(self, count: int) -> bool:
        return self.newest is not None and self.newest.count > count

    def _work(self) -> None:
        for datagram in self._inlet.packets():
            for picture in self._assembler.feed(datagram, self._clock.now()):
                with self._ready:
                    self.newest = picture
                    self._ready.notify_all()
                self._on_picture = told(self._on_picture, picture)

    def stop(self) -> None:
        """Close the socket and end the thread."""
        self._stopping = True
        self._inlet.stop()
        with self._ready:
            self._ready.notify_all()
        self._thread.join(timeout=2.0)
        self._inlet.close()
