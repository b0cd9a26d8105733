"""Video files as a source."""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.images import ASSUMED_HZ, check_size
from edgeslam_torch.readers.listing import Problem
from edgeslam_torch.readers.streams.packets import change_of_size
from edgeslam_torch.types import FloatArray, Frame

SUFFIXES = frozenset(
    f".{name}"
    for name in [
        *("mp4", "avi", "mov", "mkv", "webm", "m4v", "mpg", "mpeg", "ts", "mts", "m2ts", "vob", "mxf", "wmv", "asf"),
        *("flv", "3gp", "3g2", "ogv", "y4m", "lrv", "h264", "264", "h265", "265", "hevc", "mjpeg"),
    ]
)
PREVIEWS = frozenset({".lrv"})
"""Small copies that GoPro cameras write beside their videos."""
_RAW = frozenset({".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg"})
"""Elementary streams, without times; FFmpeg assumes 25 frames a second."""
_JOINED = _RAW | {".ts", ".mts", ".m2ts"}
"""Streams that are joined by appending one to the other."""
_GAP = 4.5
"""Usual steps between stamps from which on frames are missing, however the rate varies."""
_FIRST_BOXES = (b"ftyp", b"wide", b"mdat")
_MAX_BOXES = 64
"""Outermost parts of an MP4 that are looked at; there are about five."""


class Video:
    """One video file of known size and length; frames are decoded on demand."""

    def __init__(self, path: Path, stamps_s: list[float] | None = None) -> None:
        """Open a video and decode its first frame.

        Args:
            path: Any file that OpenCV's FFmpeg reads.
            stamps_s: Time of each frame [s] if the recording is more precise than the container.

        Raises:
            SourceError: If the file cannot be decoded.
        """
        self.path = path
        self.stamps_s = stamps_s
        capture = _opened(path)
        check_size(int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)), path)
        rate = capture.get(cv2.CAP_PROP_FPS)
        self.rate_hz = rate if math.isfinite(rate) and 0.0 < rate <= 1000.0 else ASSUMED_HZ
        self.rate_is_assumed = stamps_s is None and (path.suffix.lower() in _RAW or self.rate_hz != rate)
        """Whether neither the file nor a list has the times of its frames."""
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.count = int(count) if math.isfinite(count) and count > 0 else None
        ok, image = capture.read()
        capture.release()
        if not ok:
            raise SourceError(f"{path}: no frame of this video can be decoded")
        self.size = (image.shape[1], image.shape[0])

    def frames(self, problems: list[Problem]) -> Iterator[Frame]:
        """Frames with strictly increasing stamps; skipped ones are added to ``problems``, and an end before pictures of
        another size."""
        is_joined = self.path.suffix.lower() in _JOINED
        end, size, rest = change_of_size(_opened(self.path), self.size) if is_joined else (0, None, 0)
        capture = _opened(self.path)
        last, index, shown_s = -math.inf, -1, 0.0
        steps_s: list[float] = []
        try:
            while True:
                ok, image = capture.read()
                if not ok:
                    break
                index += 1
                if size is not None and index == end:
                    sizes = "{}x{} to {}x{}".format(*self.size, *size)
                    reason = f"the resolution changes from {sizes} at frame {index}: ended there; cut the video there"
                    problems.append(Problem(str(self.path), reason, rest))
                    return
                container_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
                shown_s = 1e-3 * container_ms if math.isfinite(container_ms) else shown_s
                stamp = self._stamp(index, container_ms)
                if stamp is None or stamp <= last:
                    reason = "has no stamp" if stamp is None else f"stamp {stamp:.6f} does not increase"
                    problems.append(Problem(f"{self.path}, frame {index}", f"{reason}; image left out"))
                    continue
                steps_s.append(stamp - last)
                last = stamp
                yield Frame(index, stamp, np.asarray(image, dtype=np.uint8), self.path)
        finally:
            capture.release()
        # Matroska has no count: OpenCV multiplies duration by rate, which is too many where the rate varies.
        whole = self.count is None or index + 1 >= 0.98 * self.count or shown_s >= 0.9 * self.count / self.rate_hz
        if self.count is not None and not whole:
            reason = f"decoding ended after {index + 1} of {self.count} frames; the file is damaged"
            problems.append(Problem(str(self.path), reason, self.count - index - 1))
        elif index + 1 < 0.98 * end and not 0.49 * end <= index + 1 <= 0.51 * end:  # packets may be halves of pictures
            reason = f"{index + 1} of {end} frames can be decoded; the file is damaged"
            problems.append(Problem(str(self.path), reason, end - index - 1))
        missing = _missing(np.array(steps_s[1:])) if is_joined and self.stamps_s is None else 0
        if missing > 0:
            reason = f"{missing} frames are missing by the stamps: the file is damaged, or was paused"
            problems.append(Problem(str(self.path), reason, frames=0))

    def _stamp(self, index: int, container_ms: float) -> float | None:
        if self.stamps_s is not None:
            return self.stamps_s[index] if index < len(self.stamps_s) else None
        if math.isfinite(container_ms) and (container_ms > 0.0 or index == 0):
            return container_ms * 1e-3
        return index / self.rate_hz


def _missing(steps_s: FloatArray) -> int:
    """How many frames gaps of many usual steps are long."""
    usual_s = np.median(steps_s) if len(steps_s) > 0 else math.inf
    return round(float(np.sum(steps_s[steps_s > _GAP * usual_s] / usual_s - 1.0)))


def _opened(path: Path) -> "cv2.VideoCapture":
    if path.suffix.lower() not in SUFFIXES:
        raise SourceError(f"{path}: not a folder of images and not a video ({', '.join(sorted(SUFFIXES))})")
    if path.stat().st_size == 0:
        raise SourceError(f"{path}: empty file")
    # FFmpeg explicitly: OpenCV's other backends treat any file name with digits as an image sequence.
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened() and _lacks_index(path):
        raise SourceError(
            f"{path}: cut off: it has no index; copy it again, or repair it in the camera or with an MP4 repair tool"
        )
    if not capture.isOpened():
        raise SourceError(
            f"{path}: not a video that can be decoded; convert it to H.264 in .mp4, or to a folder of images"
        )
    return capture


def _lacks_index(path: Path) -> bool:
    """Whether it is an MP4 or MOV that ends before its index does (``moov``), which most cameras write last."""
    length, at, kinds = path.stat().st_size, 0, list[bytes]()
    with path.open("rb") as file:
        while at < length and len(kinds) < _MAX_BOXES:
            file.seek(at)
            head = file.read(16)
            kinds.append(head[4:8])
            size = int.from_bytes(head[8:] if head[:4] == b"\0\0\0\1" else head[:4])
            at = length if size < 8 else at + size  # 0: up to the file's end
            if kinds[-1] == b"moov" and at <= length:
                return False
    return kinds[0] in _FIRST_BOXES
