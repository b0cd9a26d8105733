"""Delivery of frames: with the readings received since the last one, or at their original rate."""

import math
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Protocol

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.imu import ImuModel, ImuReadings, Reading
from edgeslam_torch.readers.read_ahead import offered, read_ahead
from edgeslam_torch.types import Frame, TelemetrySample

REALTIME_QUEUE = 15
"""Frames that may wait for a slow step, half a second at 30 a second.

Initialisation takes 0.3 s on a PC; tracking takes a third of the frame interval, so that the queue drains quickly.
"""


class _WithReadings(Protocol):
    telemetry: list[TelemetrySample]
    imu: ImuModel | None
    imu_readings: ImuReadings | None


class ReadingsCursor:
    """Readings of a source since the last frame, each exactly once; the list of telemetry may grow concurrently."""

    def __init__(self, source: _WithReadings) -> None:
        self._samples, self._imu = source.telemetry, source.imu_readings
        self._ahead_s = (source.imu.time_offset_s or 0.0) if source.imu is not None else 0.0
        self._next = 0
        self._until_s = -math.inf

    def until(self, stamp_s: float) -> list[Reading]:
        """Readings up to a frame's stamp that were not given before: of an IMU by its own clock."""
        first = self._next
        while self._next < len(self._samples) and self._samples[self._next].stamp_s <= stamp_s:
            self._next += 1
        given: list[Reading] = [*self._samples[first : self._next]]
        if self._imu is not None:
            measured = self._imu.between(self._until_s, stamp_s + self._ahead_s)
            self._until_s = max(self._until_s, stamp_s + self._ahead_s)
            given += [measured] if len(measured) else []
        return given


class Steps:
    """Base of sources."""

    name: str
    kind: str
    camera: Camera
    telemetry: list[TelemetrySample]
    imu: ImuModel | None = None
    imu_readings: ImuReadings | None = None
    length: int | None

    def frames(self) -> Iterator[Frame]:
        """As `edgeslam_torch.readers.source.Source`."""
        raise NotImplementedError

    def steps(self) -> Iterator[tuple[Frame, list[Reading]]]:
        """Each frame with the state messages and IMU readings since the one before: what `EdgeSlam.step` takes."""
        cursor = ReadingsCursor(self)
        for frame in self.frames():
            yield frame, cursor.until(frame.stamp_s)

    def __repr__(self) -> str:
        long = "frames" if self.length is None else f"at most {self.length} frames"
        size = f"{self.camera.width}x{self.camera.height}"
        sensors = f"{len(self.telemetry)} telemetry"
        sensors += "" if self.imu_readings is None else f", {len(self.imu_readings)} IMU readings"
        return f"{type(self).__name__}({self.name!r}, {self.kind}, {size}, {long}, {sensors})"


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
    begin_s: list[float] = []

    def at_its_time(buffer: "queue.Queue[Any]", frame: Frame, stop: threading.Event) -> bool:
        if not begin_s:
            begin_s.append(time.monotonic() - frame.stamp_s)
        if stop.wait(max(0.0, begin_s[0] + frame.stamp_s - time.monotonic())):
            return False
        with suppress(queue.Empty):
            while buffer.full():
                buffer.get_nowait()
                dropped.value += 1
        return offered(buffer, frame, stop)

    return read_ahead(frames, waiting, at_its_time)
