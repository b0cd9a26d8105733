"""Image files: decoding one, and a folder of them as a source."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from os.path import commonprefix
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.plain import read_bounded
from edgeslam_torch.files.time_units import UNKNOWN, is_date, seconds_of
from edgeslam_torch.readers.image_size import image_size
from edgeslam_torch.readers.levels import Levels, levels_of
from edgeslam_torch.readers.listing import ImageEntry, Problem, entries_in_time, in_order
from edgeslam_torch.types import FloatArray, Frame

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
MAX_PIXELS = 50_000_000
"""Maximum pixels of an image; 8K video has 33 million. Larger ones are rejected before decoding."""
MIN_SIDE = 32
"""Minimum width and height [px]; ORB describes a keypoint by 31 px around it."""
_MAX_BYTES = 8 * MAX_PIXELS
"""Maximum size of a file: 16 bits and four channels, uncompressed."""
_AS_IT_IS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
"""Grey or colour of any depth, without transparency."""
_LOOKED_AT = 50
"""Number of images, spread over a recording, that determine its image size."""
_JPEG = b"\xff\xd8"
_EXIF = b"Exif\0\0"
_COUNTER_STEP = 1000
"""Numbers in names that are this far apart count microseconds or nanoseconds rather than frames."""
ASSUMED_HZ = 30.0
"""Assumed rate of images without time stamps; that of webcams, Kinects and the Tello."""


class JpegFrame(Frame):
    """A JPEG frame: grey values are decoded at once, at half the cost of colours; colours on demand.

    Seven of eight frames become no keyframe and need none. Every access decodes again.
    """

    __slots__ = ("_data",)
    _data: bytes

    def __init__(self, index: int, stamp_s: float, data: bytes, path: Path) -> None:
        """Decode a file's bytes in grey.

        Raises:
            SourceError: If they are not an image, or a damaged one.
        """
        grey = _grey_of_jpeg(data, path)
        for name, value in (("index", index), ("stamp_s", stamp_s), ("path", path), ("grey", grey), ("_data", data)):
            object.__setattr__(self, name, value)

    @property
    def image(self) -> NDArray[np.uint8]:
        """``(H, W, 3)`` BGR, or ``(H, W)`` of a grey JPEG."""
        return np.asarray(_decoded(self._data, self.path, cv2.IMREAD_ANYCOLOR), dtype=np.uint8)


def read_image(path: Path) -> NDArray[np.uint8]:
    """``(H, W, 3)`` BGR or ``(H, W)`` grey, eight bits.

    Raises:
        SourceError: If the file is missing, empty, damaged, too large or no image.
    """
    return np.asarray(read_pixels(path, cv2.IMREAD_ANYCOLOR), dtype=np.uint8)


def read_pixels(path: Path, flags: int) -> NDArray[Any]:
    """The image as `decode` returns it.

    Raises:
        SourceError: If the file is missing, empty, damaged, too large or no image.
    """
    return decode(_bytes(path), path, flags)


def decode(data: bytes, name: str | Path, flags: int) -> NDArray[Any]:
    """The image in these bytes, as ``cv2.imread`` would return it; more than eight bits become eight by `levels_of`
    unless the flags ask for them.

    Raises:
        SourceError: If they are empty, damaged, too large or no image.
    """
    _check_bytes(data, name)
    if data.startswith(_JPEG):
        _grey_of_jpeg(data, name)
    if flags == cv2.IMREAD_UNCHANGED or flags & cv2.IMREAD_ANYDEPTH:
        return _decoded(data, name, flags)
    image = _decoded(data, name, flags | cv2.IMREAD_ANYDEPTH)
    return image if image.dtype == np.uint8 else levels_of([image]).eight_bits(image)


def pixels_or_none(path: Path, flags: int) -> NDArray[Any] | None:
    """As `read_pixels`; None if the file cannot be read."""
    try:
        return read_pixels(path, flags)
    except SourceError:
        return None


def read_frame(entry: ImageEntry, levels: Callable[[], Levels] | None = None) -> Frame:
    """The frame of one image file.

    Args:
        entry: The file and its stamp.
        levels: The recording's, used when the image has more than eight bits; default: by this image alone.

    Raises:
        SourceError: If the file is missing, empty, damaged, too large or no image.
    """
    data = _bytes(entry.path)
    if data.startswith(_JPEG):
        return JpegFrame(entry.index, entry.stamp_s, data, entry.path)
    image = _decoded(data, entry.path, _AS_IT_IS)
    if image.dtype != np.uint8:
        image = (levels_of([image]) if levels is None else levels()).eight_bits(image)
    return Frame(entry.index, entry.stamp_s, np.asarray(image, dtype=np.uint8), entry.path)


def check_size(width: int, height: int, name: str | Path | None) -> None:
    """Reject images with too many pixels.

    Raises:
        SourceError: If it has more than `MAX_PIXELS`.
    """
    if width * height > MAX_PIXELS:
        limit = MAX_PIXELS // 1_000_000
        raise SourceError(f"{name}: image is {width}x{height}, more than {limit} million pixels are not read")


def check_trackable(size: tuple[int, int], name: str | Path) -> None:
    """Reject images that are too small to be tracked.

    Args:
        size: ``(width, height)`` [px].
        name: Source, for the message.

    Raises:
        SourceError: If a side is shorter than `MIN_SIDE`.
    """
    if min(size) < MIN_SIDE:
        raise SourceError(f"{name}: images of {size[0]}x{size[1]} are too small to be tracked (at least {MIN_SIDE} px)")


def _bytes(path: Path) -> bytes:
    data = read_bounded(path, _MAX_BYTES, SourceError, "an image")
    _check_bytes(data, path)
    return data


def _check_bytes(data: bytes, name: str | Path) -> None:
    """Reject what is no whole image, or too large a one, before anything is decoded."""
    if not data:
        raise SourceError(f"{name}: empty file")
    if data.startswith(_JPEG) and data.rfind(b"\xff\xd9", max(0, len(data) - 65536)) < 0:  # no end marker
        raise SourceError(f"{name}: truncated image")
    size_px = image_size(data)
    if size_px is None:
        raise SourceError(f"{name}: cannot be decoded as an image")
    check_size(*size_px, name)


def _grey_of_jpeg(data: bytes, path: str | Path) -> NDArray[np.uint8]:
    """``(H, W)``.

    By OpenCV's library (libjpeg-turbo) with the same values, but warnings are errors: OpenCV returns an image for
    garbage between the first and the last byte.
    """
    from kornia_rs.io import decode_image_jpegturbo  # 10 ms that other sources do not need

    try:
        grey = decode_image_jpegturbo(data, "mono")
    except Exception as error:  # it has no other exception class
        raise SourceError(f"{path}: damaged JPEG data, or print colours (CMYK)") from error
    if data.find(_EXIF, 0, 65536) >= 0:  # it may contain an orientation, which OpenCV applies
        return np.asarray(_decoded(data, path, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return np.asarray(grey[:, :, 0], dtype=np.uint8)


def _decoded(data: bytes, path: str | Path | None, flags: int) -> NDArray[Any]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise SourceError(f"{path}: cannot be decoded as an image") from error
    if image is None:
        raise SourceError(f"{path}: cannot be decoded as an image")
    return image


def image_files(folder: Path) -> list[Path]:
    """Image files directly in a folder, ``img10`` after ``img9``; hidden files are ignored."""
    files = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in files if p.is_file()), key=_natural)


def list_image_folder(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Images of a folder without a list, by the times in their names, else by their order at `ASSUMED_HZ`.

    Raises:
        SourceError: If most names have the same time.
    """
    files = image_files(folder)
    stamps = _stamps_in_names(files)
    if stamps is not None:
        return entries_in_time(stamps, files, str(folder))
    kept, problems = in_order([ImageEntry(i, i / ASSUMED_HZ, path) for i, path in enumerate(files)], str(folder))
    if len(files) > 1:
        reason = f"file names hold no times: {ASSUMED_HZ:.0f} images/s are assumed; rgb.txt with 'stamp path' says it"
        problems.append(Problem(str(folder), reason, frames=0))
    return kept, problems


def frames_of(entries: Sequence[ImageEntry], size: tuple[int, int], problems: list[Problem]) -> Iterator[Frame]:
    """Frames in order, skipping images that cannot be read or have another size.

    Args:
        entries: In time order.
        size: ``(width, height)`` that the camera is calibrated for.
        problems: List to which each skipped image is added, and what becomes of more than eight bits.
    """

    at = 0

    @cache
    def levels() -> Levels:
        found = levels_of(_deep(entries[at:]))
        problems.append(Problem(str(entries[at].path.parent), f"more than 8 bits: {found.words}", frames=0))
        return found

    for at, entry in enumerate(entries):  # noqa: B007, of `levels`
        try:
            frame = read_frame(entry, levels)
        except SourceError as error:
            problems.append(Problem(str(entry.path), str(error).removeprefix(f"{entry.path}: ")))
            continue
        height, width = (frame.image if frame.grey is None else frame.grey).shape[:2]
        if (width, height) != size:
            reason = f"image is {width}x{height}, the others are {size[0]}x{size[1]}"
            problems.append(Problem(str(entry.path), reason))
            continue
        yield frame


def usual_size(entries: Sequence[ImageEntry], name: str) -> tuple[int, int]:
    """``(width, height)`` of most images, by a sample of them.

    Raises:
        SourceError: If none can be read, or no size is that of at least half of them.
    """
    first = ""
    for sample in (entries[:: max(1, len(entries) // _LOOKED_AT)], entries):
        sizes: dict[ImageEntry, tuple[int, int]] = {}
        for entry in sample:
            try:
                sizes[entry] = image_size(_bytes(entry.path)) or (0, 0)
            except SourceError as error:
                first = first or str(error)
        for size, count in Counter(sizes.values()).most_common():
            if 2 * count < len(sizes):
                found = ", ".join(f"{width}x{height}" for width, height in list(dict.fromkeys(sizes.values()))[:4])
                raise SourceError(f"{name}: images of several sizes ({found}), none of which most of them have")
            for entry in (entry for entry in sizes if sizes[entry] == size):
                try:
                    height, width = read_pixels(entry.path, cv2.IMREAD_GRAYSCALE).shape  # turned as EXIF data says
                except SourceError as error:
                    first = first or str(error)
                    continue
                return width, height
    raise SourceError(f"{name}: none of its images can be read ({len(entries)} listed; the first: {first})")


def _deep(entries: Sequence[ImageEntry]) -> Iterator[NDArray[Any]]:
    """Images of more than eight bits among these."""
    for entry in entries:
        try:
            image = read_pixels(entry.path, _AS_IT_IS)
        except SourceError:
            continue
        if image.dtype != np.uint8:
            yield image


def _stamps_in_names(files: Sequence[Path]) -> FloatArray | None:
    """Stamps that are names such as ``1305031102.175304.png`` or ``cam0_1403636579763555584.png``, in any unit; None of
    names without a time and of counters (``000012.png``)."""
    stems = [path.stem for path in files]
    prefix = re.sub(r"[\d.]*$", "", commonprefix(stems))
    stems = [stem.removeprefix(prefix) for stem in stems]
    if not stems or not all(re.fullmatch(r"\d+(\.\d+)?", stem) for stem in stems):
        return None
    stamps = np.array([float(stem) for stem in stems])
    seconds, unit = seconds_of(stamps)
    if unit == UNKNOWN:
        return None
    if not any("." in stem for stem in stems) and not is_date(seconds):
        gaps = np.diff(np.sort(stamps))
        if not len(gaps) or np.median(gaps) < _COUNTER_STEP:
            return None
    return stamps


def _natural(path: Path) -> tuple[list[int | str], str]:
    """Sort key under which ``img10`` comes after ``img9``."""
    # Text and digits alternate, so that equal positions have equal types.
    parts = re.split(r"(\d+)", path.stem)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
