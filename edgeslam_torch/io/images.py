"""Image files: decoding one, and a folder of them as a source."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.io.listing import ImageEntry, Problem, in_order, seconds_from
from edgeslam_torch.types import Frame

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
_JPEG = b"\xff\xd8"
ASSUMED_HZ = 30.0
"""Rate of images whose names tell no time; what webcams, Kinects and the Tello give."""


class JpegFrame(Frame):
    """A JPEG's frame: its grey values are read at once, at half the cost of colours, and those when somebody asks.

    Nobody does for the seven of eight frames that become no keyframe. Every time somebody asks they are read again.
    """

    __slots__ = ("_data",)
    _data: bytes

    def __init__(self, index: int, stamp_s: float, data: bytes, path: Path) -> None:
        """Decode a file's bytes in grey.

        Raises:
            SourceError: If they are no image.
        """
        grey = _decoded(data, path, cv2.IMREAD_GRAYSCALE)
        for name, value in (("index", index), ("stamp_s", stamp_s), ("path", path), ("grey", grey), ("_data", data)):
            object.__setattr__(self, name, value)

    @property
    def image(self) -> NDArray[np.uint8]:
        """``(H, W, 3)`` BGR, or ``(H, W)`` of a grey JPEG."""
        return _decoded(self._data, self.path, cv2.IMREAD_ANYCOLOR)


def read_image(path: Path) -> NDArray[np.uint8]:
    """``(H, W, 3)`` BGR or ``(H, W)`` grey, eight bits.

    Raises:
        SourceError: If the file is missing, empty, truncated or no image.
    """
    return _decoded(_bytes(path), path, cv2.IMREAD_ANYCOLOR)


def read_frame(entry: ImageEntry) -> Frame:
    """The frame of one image file.

    Raises:
        SourceError: If the file is missing, empty, truncated or no image.
    """
    data = _bytes(entry.path)
    if data.startswith(_JPEG):
        return JpegFrame(entry.index, entry.stamp_s, data, entry.path)
    return Frame(entry.index, entry.stamp_s, _decoded(data, entry.path, cv2.IMREAD_ANYCOLOR), entry.path)


def _bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes() if path.is_file() else None
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    if data is None:
        raise SourceError(f"{path}: no such file")
    if not data:
        raise SourceError(f"{path}: empty file")
    # OpenCV 4 fills the missing part of a cut-off JPEG with grey and says nothing: look for the end marker.
    if data.startswith(_JPEG) and data.rfind(b"\xff\xd9", max(0, len(data) - 65536)) < 0:
        raise SourceError(f"{path}: truncated image")
    return data


def _decoded(data: bytes, path: Path | None, flags: int) -> NDArray[np.uint8]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise SourceError(f"{path}: cannot be decoded as an image") from error
    if image is None:
        raise SourceError(f"{path}: cannot be decoded as an image")
    return np.asarray(image, dtype=np.uint8)


def image_files(folder: Path) -> list[Path]:
    """Image files directly in a folder, ``img10`` after ``img9``; hidden files are passed over."""
    files = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in files if p.is_file()), key=_natural)


def entries_from_names(files: Sequence[Path]) -> list[ImageEntry]:
    """Entries with stamps read from names like ``1305031102.175304.png`` or ``1403636579763555584.png``.

    Names that tell no time (``frame_0012.png``) get 30 Hz in their order.
    """
    stamps = _stamps_in_names(files)
    if stamps is None:
        stamps = [i / ASSUMED_HZ for i in range(len(files))]
    return [ImageEntry(i, stamp, path) for i, (stamp, path) in enumerate(zip(stamps, files, strict=True))]


def list_image_folder(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Images of a folder that has no list of its own."""
    return in_order(entries_from_names(image_files(folder)), str(folder))


def frames_of(entries: Sequence[ImageEntry], size: tuple[int, int], problems: list[Problem]) -> Iterator[Frame]:
    """Frames in order, without images that cannot be read or have another size.

    Args:
        entries: In time order.
        size: ``(width, height)`` that the camera is calibrated for.
        problems: Gets a line for each image left out.
    """
    for entry in entries:
        try:
            frame = read_frame(entry)
        except SourceError as error:
            problems.append(Problem(str(entry.path), str(error).removeprefix(f"{entry.path}: ")))
            continue
        height, width = (frame.image if frame.grey is None else frame.grey).shape[:2]
        if (width, height) != size:
            reason = f"image is {width}x{height}, the others are {size[0]}x{size[1]}"
            problems.append(Problem(str(entry.path), reason))
            continue
        yield frame


def first_size(entries: Sequence[ImageEntry], name: str) -> tuple[int, int]:
    """``(width, height)`` of the first image that can be read.

    Raises:
        SourceError: If none can.
    """
    first = ""
    for entry in entries:
        try:
            image = read_image(entry.path)
        except SourceError as error:
            first = first or str(error)
            continue
        return image.shape[1], image.shape[0]
    raise SourceError(f"{name}: none of its images can be read ({len(entries)} listed; the first: {first})")


def _stamps_in_names(files: Sequence[Path]) -> list[float] | None:
    stems = [path.stem for path in files]
    if not stems or not all(re.fullmatch(r"\d+(\.\d+)?", stem) for stem in stems):
        return None
    has_point = any("." in stem for stem in stems)
    stamps, unit = seconds_from([float(stem) for stem in stems])
    if not has_point and unit == "s" and float(np.median(stamps)) < 1e9:
        return None  # 000012.png counts frames
    gaps = np.diff(np.sort(stamps))
    if len(gaps) and not 1e-4 < float(np.median(gaps)) < 60.0:
        return None
    return stamps.tolist()


def _natural(path: Path) -> tuple[list[int | str], str]:
    """Sort key under which ``img10`` comes after ``img9``."""
    # Text and digits alternate, so that position by position like is compared with like.
    parts = re.split(r"(\d+)", path.stem)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
