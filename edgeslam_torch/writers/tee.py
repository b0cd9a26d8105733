"""Recording of a live source while it is used."""

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from edgeslam_torch.errors import OutputError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.listing import Problem
from edgeslam_torch.readers.live import LiveSource
from edgeslam_torch.readers.pace import Steps
from edgeslam_torch.types import Frame, TelemetrySample
from edgeslam_torch.writers.flight_writer import FlightWriter

logger = logging.getLogger(__name__)

_WAITING = 60
"""Maximum queue of frames for the disk (two seconds, 120 MB at 960x720); beyond, camera frames are skipped."""


class RecordedLive(Steps):
    """Implements `edgeslam_torch.readers.source.Source`: frames taken from it are also recorded.

    Only frames that were taken are recorded, so that a replay processes the same frames.
    """

    groundtruth: Path | None = None
    live = True

    def __init__(self, source: LiveSource, folder: Path, lossless: bool) -> None:
        """Open the folder.

        Args:
            source: Source to record.
            folder: Folder of the recording.
            lossless: PNG, so that the pictures are bit-identical.

        Raises:
            OutputError: If it holds a recording already or cannot be written; the source is closed.
        """
        self.name, self.kind, self.location = source.name, source.kind, source.location
        self.camera: Camera = source.camera
        self.telemetry: list[TelemetrySample] = source.telemetry
        self.length: int | None = source.length
        self.problems: list[Problem] = source.problems
        self.warnings: list[str] = source.warnings
        self._source = source
        try:
            self._writer = FlightWriter(folder, source.camera, source.location.startswith("tello://"), lossless)
        except OutputError:
            source.close()
            raise
        self._queue: queue.Queue[Frame | None] = queue.Queue(maxsize=_WAITING)
        self._failure: str | None = None
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()
        self._closed = False

    @property
    def silent_s(self) -> float:
        """Since the last picture."""
        return self._source.silent_s

    def frames(self) -> Iterator[Frame]:
        """Frames of the source; a write error ends the recording, not the flight."""
        try:
            for frame in self._source.frames():
                self._queue.put(frame)
                yield frame
        finally:
            self.close()

    def close(self) -> None:
        """Close the source, then write the queued frames."""
        if self._closed:
            return
        self._closed = True
        self._source.close()
        self._queue.put(None)
        self._thread.join()
        self._write_states()
        self._writer.close()
        if self._failure is not None:
            self.problems.append(Problem(str(self._writer.folder), self._failure, frames=0))

    def _work(self) -> None:
        while (frame := self._queue.get()) is not None:
            self._guarded(partial(self._writer.add_frame, frame))
            self._write_states()

    def _write_states(self) -> None:
        while self._failure is None and self._writer.states < len(self._source.messages):
            self._guarded(partial(self._writer.add_state, self._source.messages[self._writer.states]))

    def _guarded(self, write: Callable[[], None]) -> None:
        """After the first failure nothing more is written; the queue is still drained, so that the producer never
        blocks."""
        if self._failure is not None:
            return
        try:
            write()
        except OutputError as error:
            logger.warning("the recording ends here: %s", error)
            self._failure = str(error)
        except Exception as error:  # an error here must not block a drone's frames
            logger.exception("the recording ends here")
            self._failure = f"{self._writer.folder}: recording failed: {error}"
