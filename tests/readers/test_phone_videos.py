"""Videos as phones make them: variable frame rate, turned by metadata."""

import struct
from fractions import Fraction

import numpy as np
import pytest

from edgeslam_torch.readers.source import open_source

av = pytest.importorskip("av")
STAMPS_MS = [0, 33, 66, 133, 150, 300, 333, 366, 500, 600, 633, 700]
"""A phone in the dark: the rate drops."""
LEFT_BRIGHT = 24
"""Pixels of the first picture that are bright, from its left."""


def _write(path, codec="libx264", stamps_ms=STAMPS_MS):
    """Pictures whose bright part grows by two pixels a frame."""
    try:
        container = av.open(str(path), "w")
        stream = container.add_stream(codec, rate=30, options={"bf": "3"} if codec == "libx264" else {})
    except (ValueError, av.FFmpegError) as error:
        pytest.skip(f"PyAV has no {codec}: {error}")
    stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
    stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
    for i, stamp in enumerate(stamps_ms):
        image = np.zeros((96, 128, 3), np.uint8)
        image[:, : LEFT_BRIGHT + 2 * i] = 220
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = stamp, Fraction(1, 1000)
        for packet in stream.encode(frame):
            container.mux(packet)
    for packet in stream.encode():
        container.mux(packet)
    container.close()
    return path


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "libx264"), ("a.mov", "libx264"), ("a.mkv", "libx264"), ("a.webm", "libvpx")]
)
def test_a_varying_rate_gives_the_stamps_of_the_container(tmp_path, name, codec):
    source = open_source(_write(tmp_path / name, codec))
    frames = list(source.frames())
    assert [1e3 * frame.stamp_s for frame in frames] == pytest.approx(STAMPS_MS, abs=1.0)
    widths = [int((frame.image[48, :, 0] > 110).sum()) for frame in frames]
    assert widths == pytest.approx([LEFT_BRIGHT + 2 * i for i in range(12)], abs=1)  # B-frames: in order of display
    assert source.problems == []


def _turn(path, matrix):
    """Write the display matrix of the track header (ISO 14496-12, 8.3.2), as a phone held upright does."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    assert struct.unpack(">9i", data[at : at + 36]) == (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    data[at : at + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("a", "b", "bright"), [(0, 65536, "top"), (0, -65536, "bottom"), (-65536, 0, "right")], ids=["90", "270", "180"]
)
def test_a_turned_phone_gives_upright_pictures(tmp_path, a, b, bright):
    path = _write(tmp_path / "a.mp4")
    # x' = a x - b y + tx, y' = b x + a y + ty
    shift = (96 << 16 if b > 0 else 128 << 16 if a < 0 else 0, 128 << 16 if b < 0 else 96 << 16 if a < 0 else 0)
    _turn(path, (a, b, 0, -b, a, 0, *shift, 1 << 30))
    source = open_source(path)
    image = next(source.frames()).image
    assert image.shape == ((128, 96, 3) if b else (96, 128, 3))
    assert (source.camera.width, source.camera.height) == (image.shape[1], image.shape[0])
    middle = image[..., 0][image.shape[0] // 2], image[..., 0][:, image.shape[1] // 2]
    sides = {"left": middle[0][3], "right": middle[0][-4], "top": middle[1][3], "bottom": middle[1][-4]}
    assert sides[bright] > 180 and {side for side, value in sides.items() if value > 180} >= {bright}
    assert sides[{"top": "bottom", "bottom": "top", "right": "left"}[bright]] < 60


def test_a_cut_file_is_still_said_to_be_damaged(tmp_path):
    path = _write(tmp_path / "a.mkv", stamps_ms=[33 * i for i in range(90)])
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = open_source(path)
    count = len(list(source.frames()))
    assert 0 < count < 80 and "damaged" in source.problems[-1].reason


def test_a_picture_twice_as_wide_as_high_is_doubted(tmp_path, write_images):
    (path,) = write_images(tmp_path, ["pano.png"], size=(512, 256))
    assert any("panorama" in warning for warning in open_source(path).warnings)
