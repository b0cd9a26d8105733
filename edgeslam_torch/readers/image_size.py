"""Width and height of an image file from its header: a small file may claim gigabytes of pixels."""

import re
import struct

_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers SOF0 to SOF15; the three others define tables."""
_TIFF_ORDER = {b"II*\0": "<", b"MM\0*": ">"}


def image_size(data: bytes) -> tuple[int, int] | None:
    """``(width, height)`` of a PNG, JPEG, BMP, TIFF, WebP or portable any-map; None when it is none of these."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _pair(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if data[:4] in _TIFF_ORDER:
            return _tiff(data, _TIFF_ORDER[data[:4]])
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp(data)
        match = _PNM.match(data)
        return (int(match[1]), int(match[2])) if match else None
    except (struct.error, IndexError):
        return None


def _pair(layout: str, data: bytes, offset: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, offset)
    return first, second


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """ITU T.81, annex B: segments of a marker, a length and so many bytes."""
    at = 2
    while data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _JPEG_FRAMES:
            height, width = _pair(">HH", data, at + 5)
            return width, height
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _bmp(data: bytes) -> tuple[int, int]:
    of_os2 = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = _pair("<HH" if of_os2 else "<ii", data, 18)
    return abs(width), abs(height)  # a negative height: rows from the top


def _tiff(data: bytes, order: str) -> tuple[int, int] | None:
    """TIFF 6.0, section 2: a directory of (tag, type, count, value); of a repeated tag the larger value counts."""
    at = struct.unpack_from(order + "I", data, 4)[0]
    size = {256: 0, 257: 0}
    for i in range(struct.unpack_from(order + "H", data, at)[0]):
        entry = at + 2 + 12 * i
        tag, kind = _pair(order + "HH", data, entry)
        if tag in size:
            size[tag] = max(size[tag], struct.unpack_from(order + ("H" if kind == 3 else "I"), data, entry + 8)[0])
    return (size[256], size[257]) if all(size.values()) else None


def _webp(data: bytes) -> tuple[int, int] | None:
    """https://developers.google.com/speed/webp/docs/riff_container."""
    if data[12:16] == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if data[12:16] == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = _pair("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF
