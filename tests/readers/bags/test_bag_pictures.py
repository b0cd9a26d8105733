"""Encodings of pictures, against values worked out by hand or by OpenCV's inverse."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.bags.pictures import PictureDecoder

RED, GREEN, BLUE = (0, 0, 255), (0, 255, 0), (255, 0, 0)


def _message(encoding, data, width, height, step=0, big=0):
    data = np.frombuffer(bytes(data), np.uint8)
    return SimpleNamespace(encoding=encoding, width=width, height=height, step=step, is_bigendian=big, data=data)


def _read(*args, **kwargs):
    return PictureDecoder("a.bag:/x").decode(_message(*args, **kwargs))


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("rgb8", (255, 0, 0)),
        ("bgr8", (0, 0, 255)),
        ("8UC3", (0, 0, 255)),
        ("rgba8", (255, 0, 0, 9)),
        ("bgra8", (0, 0, 255, 9)),
    ],
)
def test_one_red_pixel(encoding, data):
    assert _read(encoding, data, 1, 1)[0, 0].tolist() == list(RED)


def test_grey_rows_lose_their_padding():
    for encoding in ("mono8", "8UC1"):
        assert _read(encoding, [1, 2, 99, 3, 4, 99], 2, 2, step=3).tolist() == [[1, 2], [3, 4]]
        assert _read(encoding, [1, 2, 99, 3, 4], 2, 2, step=3).tolist() == [[1, 2], [3, 4]]  # last row cut short


def test_twelve_bits_in_sixteen_of_both_byte_orders_keep_their_range():
    values = np.array([[0, 16, 4095, 2048]], np.uint16)
    for order, big in (("<u2", 0), (">u2", 1)):
        assert _read("mono16", values.astype(order).tobytes(), 4, 1, big=big).tolist() == [[0, 1, 255, 128]]


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("colour", [RED, GREEN, BLUE])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_patterns_give_the_colour_that_made_them(pattern, colour, bits):
    # ROS names the 2x2 cell row by row; an even colour gives the same value at all cells of its channel.
    channel = {"r": 2, "g": 1, "b": 0}
    cell = np.array([colour[channel[c]] for c in pattern], np.uint16).reshape(2, 2)
    mosaic = np.tile(cell, (4, 4))
    data = mosaic.astype(np.uint8).tobytes() if bits == 8 else (mosaic * 257).astype("<u2").tobytes()
    image = _read(f"bayer_{pattern}{bits}", data, 8, 8)
    assert np.abs(image[2:-2, 2:-2].astype(int) - colour).max() <= 1


def test_yuv_orders():
    # BT.601 video range: red is Y 82, U 90, V 240.
    for encoding, data in {
        "yuv422": (90, 82, 240, 82),
        "uyvy": (90, 82, 240, 82),
        "yuv422_yuy2": (82, 90, 82, 240),
        "yuyv": (82, 90, 82, 240),
    }.items():
        assert np.abs(_read(encoding, data, 2, 1).astype(int) - RED).max() <= 3, encoding


@pytest.mark.parametrize(
    ("encoding", "count", "width", "height"),
    [("32FC1", 4, 1, 1), ("nv12", 6, 2, 2), ("rgb8", 5, 1, 2), ("rgb8", 0, 0, 0)]
    + [("yuyv", 18, 3, 3), ("uyvy", 2, 1, 1), ("yuv422", 10, 5, 1), ("mono8", 1, 10**6, 10**6)],
)
def test_what_is_no_picture_is_refused(encoding, count, width, height):
    with pytest.raises(SourceError, match=f"{encoding}|million"):
        _read(encoding, [0] * count, width, height)


def test_compressed_pictures_are_checked_as_files_are():
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (40, 60), dtype=np.uint8), (0, 0), 2)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    huge = bytearray(cv2.imencode(".png", picture)[1].tobytes())
    huge[16:24] = (30_000).to_bytes(4, "big") * 2
    damaged = bytearray(jpeg)
    damaged[len(jpeg) // 2 : len(jpeg) // 2 + 40] = b"\xff" * 40
    for data, word in (
        (b"", "empty"),
        (jpeg[:-40], "truncated"),
        (bytes(damaged), "damaged"),
        (bytes(huge), "million"),
    ):
        with pytest.raises(SourceError, match=word):
            PictureDecoder("x").decode(SimpleNamespace(format="jpeg", data=np.frombuffer(data, np.uint8)))


def test_the_first_picture_sets_the_range_of_all():
    decoder = PictureDecoder("x")
    bright, dark = (np.full((2, 2), value, "<u2").tobytes() for value in (65535, 255))
    assert decoder.decode(_message("mono16", bright, 2, 2)).max() == 255
    assert decoder.decode(_message("mono16", dark, 2, 2)).max() == 0


def test_a_row_of_four_gigabytes_in_one_line_costs_no_memory():
    message = _message("mono8", [7] * 6, 6, 1)
    message.step = 4_000_000_000
    assert (PictureDecoder("x").decode(message) == 7).all()
