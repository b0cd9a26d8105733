"""Live sources: a Tello, a webcam, a network stream. They provide the newest picture, never a queue."""

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from edgeslam_torch.calibration.camera_choice import choose_camera
from edgeslam_torch.drone.tello import StateMessage, Tello, TelloAddress, TelloError
from edgeslam_torch.drone.video_stream import ArrivalClock, OneSize, Picture
from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.gstreamer import SCHEME, GStreamerCapture
from edgeslam_torch.readers.images import check_trackable
from edgeslam_torch.readers.listing import Problem
from edgeslam_torch.readers.pace import Steps
from edgeslam_torch.readers.streams.packets import decoded_here
from edgeslam_torch.types import Frame, TelemetrySample

FIRST_PICTURE_S = 10.0
"""A Tello's first pictures cannot be decoded until a keyframe comes."""
SILENCE_S = 10.0
"""After this time without a picture the source has ended."""
RESTART_S = 40.0
"""The same for a drone: the time to restart it and to reconnect to its Wi-Fi."""
_MAX_NAME = 60
"""Characters of an address in a folder's name."""
_SLICE_S = 0.1
"""Polling interval of a waiting source."""


class Feed(Protocol):
    """Source of pictures."""

    def wait(self, after_count: int, timeout_s: float) -> Picture | None:
        """The newest picture after ``after_count``; None after the timeout."""

    def remarks(self) -> list[str]:
        """Warnings about the received data."""

    def close(self) -> None:
        """Release the device."""


class LiveSource(Steps):
    """A free-running camera; implements `edgeslam_torch.readers.source.Source`."""

    kind = "live"
    groundtruth: Path | None = None
    live = True

    def __init__(
        self,
        location: str,
        feed: Feed,
        camera: str | Path | None,
        max_frames: int | None,
        telemetry: list[TelemetrySample] | None = None,
        messages: list[StateMessage] | None = None,
    ) -> None:
        """Wait for the first picture, which has the size.

        Args:
            location: Address.
            feed: Its pictures.
            camera: Calibration file or preset.
            max_frames: Maximum number of frames.
            telemetry: Of a drone; it grows.
            messages: What the drone says, as it says it; it grows.

        Raises:
            SourceError: If none comes.
            CalibrationError: If the calibration does not fit.
        """
        self.location = location
        self.name = re.sub(r"[^A-Za-z0-9.-]+", "_", location).strip("_")[:_MAX_NAME] or "live"
        self.telemetry = telemetry if telemetry is not None else []
        self.messages = messages if messages is not None else []
        self.length = max_frames
        self.problems: list[Problem] = []
        self.silent_s = 0.0
        """Since the last picture."""
        self._feed = feed
        is_drone = telemetry is not None
        self._silence_s = RESTART_S if is_drone else SILENCE_S
        self._told_to_end = self._closed = False
        first = feed.wait(0, FIRST_PICTURE_S)
        if first is None:
            feed.close()
            raise SourceError(f"{location}: no picture in {FIRST_PICTURE_S:.0f} s")
        size = (first.image.shape[1], first.image.shape[0])
        self._one_size = OneSize(size)
        try:
            check_trackable(size, location)
            self.camera: Camera
            self.warnings: list[str]
            self.camera, self.warnings = choose_camera(size, camera, (), None, is_drone)
        except BaseException:
            feed.close()
            raise

    def frames(self) -> Iterator[Frame]:
        """Pictures as they arrive; a slow consumer misses some, visible as gaps in the index. Closes the device at
        the end.

        Raises:
            TelloError: If a guard has ended the flight.
            SourceError: If the pictures' size has changed for good; single odd ones are left out.
        """
        last = given = 0
        try:
            while self.length is None or given < self.length:
                picture = self._next(last)
                if picture is None:
                    return
                last = picture.count
                if self._fits(picture):
                    given += 1
                    yield Frame(picture.count - 1, picture.stamp_s, picture.image)
        finally:
            self.close()

    def _next(self, last: int) -> Picture | None:
        for waited in range(round(self._silence_s / _SLICE_S)):
            self.silent_s = waited * _SLICE_S
            if self._told_to_end:
                return None
            picture = self._feed.wait(last, _SLICE_S)
            if picture is not None:
                self.silent_s = 0.0
                return picture
        self.problems.append(Problem(self.location, f"no picture for {self._silence_s:.0f} s; ended", frames=0))
        return None

    def _fits(self, picture: Picture) -> bool:
        try:
            if self._one_size.fits(picture):
                return True
        except SourceError as error:
            raise SourceError(f"{self.location}: {error}") from error
        if self._one_size.odd == 1:  # it and those like it are gaps in the index, which are counted
            height, width = picture.image.shape[:2]
            reason = "is {}x{}, not {}x{}; such pictures are left out".format(width, height, *self._one_size.size)
            self.problems.append(Problem(f"picture {picture.count}", reason, frames=0))
        return False

    def end(self) -> None:
        """End `frames` after the current picture; callable from any thread or a signal handler."""
        self._told_to_end = True

    def close(self) -> None:
        """Release the device; `warnings` is complete afterwards."""
        self._feed.close()
        if not self._closed:
            self._closed = True
            self.warnings += [f"{self.location}: {remark}" for remark in self._feed.remarks()]


class TelloFeed:
    """Pictures and telemetry of a drone."""

    def __init__(self, tello: Tello) -> None:
        self.tello = tello
        self.video = tello.start_video()

    def wait(self, after_count: int, timeout_s: float) -> Picture | None:
        """As `Feed`.

        Raises:
            TelloError: If a guard has ended the flight.
        """
        if self.tello.stop_reason:
            raise TelloError(f"{self.tello.address.host}: the flight was ended: {self.tello.stop_reason}")
        return self.video.wait(after_count, timeout_s)

    def remarks(self) -> list[str]:
        """As `Feed`: packets of other senders or unreadable ones."""
        remarks = []
        refused = {channel: count for channel, count in self.tello.refused.items() if count}
        if refused:
            listing = ", ".join(f"{channel} {count}" for channel, count in refused.items())
            remarks.append(f"{sum(refused.values())} packets from others than the drone were refused ({listing})")
        if self.tello.silences:
            times = "once" if self.tello.silences == 1 else f"{self.tello.silences} times"
            remarks.append(f"the stream stopped {times} and was requested again; a restarted drone has reset its frame")
        if self.tello.malformed:
            remarks.append(f"{self.tello.malformed} state messages could not be read")
        return remarks

    def close(self) -> None:
        """Land if this client took off, and leave."""
        self.tello.close()


class CaptureFeed:
    """OpenCV's capture in a thread that keeps only the newest picture."""

    def __init__(self, device: int | str, name: str) -> None:
        """Open the device, address or pipeline.

        Raises:
            SourceError: If it cannot be opened.
        """
        self._capture = _opened(device, name)
        self._clock = ArrivalClock()
        self._ready = threading.Condition()
        self._newest: Picture | None = None
        self._stopping = False
        self._ended = False
        self._thread = threading.Thread(target=self._work, name="capture", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        count = 0
        while not self._stopping:
            ok, image = self._capture.read()
            stamp = self._clock.now()
            with self._ready:
                if not ok:
                    self._ended = True
                elif image is not None:
                    count += 1
                    self._newest = Picture(stamp, np.asarray(image, dtype=np.uint8), count)
                self._ready.notify_all()
            if not ok:
                return

    def wait(self, after_count: int, timeout_s: float) -> Picture | None:
        """As `Feed`."""

        def later() -> bool:
            return self._newest is not None and self._newest.count > after_count

        with self._ready:
            self._ready.wait_for(lambda: self._ended or later(), timeout_s)
            return self._newest if later() else None

    def remarks(self) -> list[str]:
        """As `Feed`; none."""
        return []

    def close(self) -> None:
        """Release the device."""
        self._stopping = True
        self._thread.join(timeout=2.0)
        self._capture.release()


class Capture(Protocol):
    """The part of `cv2.VideoCapture` that is used."""

    def read(self) -> tuple[bool, Any]:
        """Whether the source goes on, and the picture, if one is whole."""

    def release(self) -> None:
        """Close."""


def _opened(device: int | str, name: str) -> Capture:
    if isinstance(device, str) and device.startswith(SCHEME):
        return GStreamerCapture(device)
    if isinstance(device, int):
        capture = cv2.VideoCapture(device)
    else:
        limit_ms = round(1e3 * FIRST_PICTURE_S)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        capture = cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)
    if not capture.isOpened():
        capture.release()
        raise SourceError(f"{name}: cannot be opened; is it there, and free?")
    return capture if isinstance(device, int) else decoded_here(capture) or capture


def without_password(address: str) -> str:
    """An address that may be shown and shared: ``rtsp://user:secret@camera/1`` without user and password."""
    return re.sub(r"//[^/?#]*@", "//", address)


def open_live(spec: str, camera: str | Path | None = None, max_frames: int | None = None) -> LiveSource:
    """Open ``tello://HOST[:PORTS]``, ``webcam:N``, ``rtsp://...``, ``udp://...``, ``http://...`` or ``gst:PIPELINE``.

    A Tello is only observed: no motion command is sent.

    Raises:
        SourceError: If it cannot be reached or gives no picture.
        TelloError: If the drone does not answer.
        CalibrationError: If the calibration does not fit.
    """
    if spec.startswith("tello://"):
        return open_tello(spec, camera, max_frames)[0]
    device: int | str = spec
    if spec.startswith("webcam:"):
        number = spec.removeprefix("webcam:")
        if not (number.isascii() and number.isdigit() and len(number) < 6):
            raise SourceError(f"{spec}: give webcam:N with a number, such as webcam:0")
        device = int(number)
    shown = without_password(spec)
    return LiveSource(shown, CaptureFeed(device, shown), camera, max_frames)


def open_tello(
    spec: str, camera: str | Path | None = None, max_frames: int | None = None, allow_motion: bool = False
) -> tuple[LiveSource, Tello]:
    """A drone as a source, with its client.

    Raises:
        SourceError: If PyAV is missing, a port is taken, or no picture comes.
        TelloError: If the drone does not answer.
        CalibrationError: If the calibration does not fit.
    """
    telemetry: list[TelemetrySample] = []
    messages: list[StateMessage] = []

    def keep(message: StateMessage) -> None:
        messages.append(message)
        telemetry.append(message.sample())

    tello = Tello(TelloAddress.parse(spec), allow_motion, on_state=keep)
    try:
        tello.connect()
        feed = TelloFeed(tello)
    except BaseException:
        tello.close()
        raise
    return LiveSource(spec, feed, camera, max_frames, telemetry, messages), tello
