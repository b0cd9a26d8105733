"""A GStreamer pipeline as a camera: ``gst-launch-1.0`` runs it and sends its pictures through a pipe.

OpenCV's wheels are built without GStreamer; any installed version works.
"""

import shlex
import shutil
import subprocess
import tempfile

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.images import check_size

SCHEME = "gst:"
_PROGRAM = "gst-launch-1.0"
_MAX_LINE = 1024


class GStreamerCapture:
    """Reads as `cv2.VideoCapture` does."""

    def __init__(self, spec: str) -> None:
        """Start the pipeline.

        Args:
            spec: ``gst:`` and a pipeline that ends in raw pictures, such as ``gst:v4l2src ! jpegdec``; an ``appsink``
                at its end, as OpenCV expects it, is removed.

        Raises:
            SourceError: If GStreamer is not installed, or the pipeline gives no picture.
        """
        words = shlex.split(spec.removeprefix(SCHEME))
        last = max((i for i, word in enumerate(words) if word == "!"), default=len(words))
        if words[last + 1 : last + 2] == ["appsink"]:
            words = words[:last]
        if not words:
            raise SourceError(f"{spec}: give a pipeline, such as 'gst:v4l2src device=/dev/video0'")
        if shutil.which(_PROGRAM) is None:
            raise SourceError(f"{spec}: {_PROGRAM} is not installed (Debian: apt install gstreamer1.0-tools)")
        end = ["!", "videoconvert", "!", "video/x-raw,format=I420", "!", "y4menc", "!", "fdsink", "fd=1"]
        self._said = tempfile.TemporaryFile()  # an unread pipe would block a pipeline with much output  # noqa: SIM115
        self._process = subprocess.Popen(
            [_PROGRAM, "-q", *words, *end],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=self._said,
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        try:
            self._width, self._height = _size(self._pipe.readline(_MAX_LINE).decode("ascii", "replace"), spec)
        except SourceError as error:
            self.release()
            raise SourceError(f"{error} ({self._complaint()})") from error

    def read(self) -> tuple[bool, NDArray[np.uint8] | None]:
        """The next picture ``(H, W, 3)`` BGR; False at the end."""
        if not self._pipe.readline(_MAX_LINE).startswith(b"FRAME"):
            return False, None
        count = self._width * self._height * 3 // 2
        data = self._pipe.read(count)
        if len(data) < count:
            return False, None
        planes = np.frombuffer(data, np.uint8).reshape(self._height * 3 // 2, self._width)
        return True, np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420), np.uint8)

    def release(self) -> None:
        """End the pipeline."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=2.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _complaint(self) -> str:
        """GStreamer's error output."""
        self._said.seek(0)
        lines = self._said.read().decode("utf-8", "replace").splitlines()
        return next((" ".join(line.split())[:160] for line in lines if "ERROR" in line or "WARN" in line), "no reason")


def _size(header: str, spec: str) -> tuple[int, int]:
    """Width and height by the header of a YUV4MPEG2 stream (https://wiki.multimedia.cx/index.php/YUV4MPEG2)."""
    fields = {word[0]: word[1:] for word in header.split()[1:]}
    if not header.startswith("YUV4MPEG2") or not (fields.get("W", "").isdigit() and fields.get("H", "").isdigit()):
        raise SourceError(f"{spec}: the pipeline gives no picture")
    width, height = int(fields["W"]), int(fields["H"])
    check_size(width, height, spec)
    if width % 2 or height % 2 or not width * height:
        raise SourceError(
            f"{spec}: pictures of {width}x{height} px; both must be even, add: ! videoscale ! video/x-raw,width="
        )
    return width, height
