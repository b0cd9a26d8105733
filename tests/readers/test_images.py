"""Frames of image files."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.images import frames_of, pixels_or_none, read_frame, read_image, read_pixels, usual_size
from edgeslam_torch.readers.listing import ImageEntry


def picture():
    """Smooth, as a camera's: what JPEG loses is small."""
    noise = np.random.default_rng(3).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 6.0)


@pytest.fixture
def entry(tmp_path):
    def write(name, image):
        assert cv2.imwrite(str(tmp_path / name), image)
        return ImageEntry(4, 0.5, tmp_path / name)

    return write


def test_a_jpeg_is_read_in_grey_and_in_colour_when_asked(entry):
    listed = entry("a.jpg", picture())
    frame = read_frame(listed)
    assert (frame.index, frame.stamp_s, frame.path) == (4, 0.5, listed.path)
    np.testing.assert_array_equal(frame.image, read_image(listed.path))
    assert frame.grey.shape == (60, 80)
    off = frame.grey.astype(int) - cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    assert np.abs(off).max() <= 3
    assert abs(off.mean()) < 0.5
    grey = read_frame(entry("grey.jpg", picture()[:, :, 0]))
    np.testing.assert_array_equal(grey.image, grey.grey)
    other = read_frame(entry("a.png", picture()))
    np.testing.assert_array_equal(other.image, picture())
    assert other.grey is None


def test_a_jpeg_that_is_none_or_of_another_size_is_left_out(entry, tmp_path):
    good, small = entry("a.jpg", picture()), entry("b.jpg", picture()[:40])
    broken, cut = tmp_path / "c.jpg", tmp_path / "d.jpg"
    broken.write_bytes(good.path.read_bytes()[:80] + b" no image \xff\xd9")
    cut.write_bytes(good.path.read_bytes()[:-200])
    problems = []
    entries = [good, small, ImageEntry(5, 0.6, broken), ImageEntry(6, 0.7, cut)]
    frames = list(frames_of(entries, (80, 60), problems))
    assert [f.path for f in frames] == [good.path]
    assert [p.reason for p in problems] == [
        "image is 80x40, the others are 80x60",
        "cannot be decoded as an image",
        "truncated image",
    ]


@pytest.mark.parametrize("what", ["noise", "text", "zeros", "missing"])
def test_a_jpeg_with_garbage_inside_is_left_out_and_named(entry, what):
    """OpenCV gives a picture for each of these and says nothing."""
    texture = np.random.default_rng(3).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    listed = entry("a.jpg", cv2.GaussianBlur(texture, (0, 0), 1.0))
    data = listed.path.read_bytes()
    garbage = {"noise": np.random.default_rng(4).bytes(3000), "text": b"garbage " * 375, "zeros": bytes(3000)}
    middle = len(data) // 2
    listed.path.write_bytes(data[:middle] + garbage.get(what, b"") + data[middle + 3000 :])
    assert cv2.imread(str(listed.path)) is not None
    problems = []
    assert list(frames_of([listed], (320, 240), problems)) == []
    assert [(p.file, p.reason) for p in problems] == [(str(listed.path), "damaged JPEG data, or print colours (CMYK)")]
    with pytest.raises(SourceError, match="damaged"):
        read_image(listed.path)


def test_a_picture_turned_by_its_camera_is_turned_in_grey_and_colour(entry):
    listed = entry("a.jpg", picture())
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: a quarter turn
    exif = b"\xff\xe1" + (8 + len(tiff)).to_bytes(2, "big") + b"Exif\0\0" + tiff
    listed.path.write_bytes(b"\xff\xd8" + exif + listed.path.read_bytes()[2:])
    frame = read_frame(listed)
    assert frame.grey.shape == frame.image.shape[:2] == (80, 60)
    assert usual_size([listed], "here") == (60, 80)


def bomb(path, width, height):
    """A PNG that says it is so large."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    parts = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def test_an_image_of_too_many_pixels_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    path = bomb(tmp_path / "bomb.png", 17000, 17000)
    monkeypatch.setattr(cv2, "imdecode", None)
    reason = "image is 17000x17000, more than 50 million pixels are not read"
    for read in (read_image, lambda p: read_frame(ImageEntry(0, 0.0, p)), lambda p: read_pixels(p, -1)):
        with pytest.raises(SourceError, match=f"bomb.png: {reason}"):
            read(path)
    problems = []
    assert list(frames_of([ImageEntry(0, 0.0, path)], (64, 48), problems)) == []
    assert problems[0].reason == reason
    assert pixels_or_none(path, -1) is None


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_keep_their_contrast_and_are_reported_once(tmp_path, channels):
    grey = np.arange(80 * 60).reshape(60, 80) % 251
    deep = (7000 + np.repeat(grey[..., None], channels, axis=2)).astype(np.uint16)
    entries = [ImageEntry(i, i / 10, tmp_path / f"{i}.png") for i in range(15)]
    for entry in entries:
        cv2.imwrite(str(entry.path), deep.squeeze())
    problems = []
    frames = list(frames_of(entries, (80, 60), problems))
    assert len(frames) == 15
    assert frames[14].image.shape == ((60, 80) if channels == 1 else (60, 80, 3))
    assert np.ptp(frames[14].image.astype(int)) > 150
    assert ["8 bits" in problem.reason for problem in problems] == [True]
    assert np.ptp(read_image(entries[0].path).astype(int)) > 150


@pytest.mark.parametrize("odd", [0, 3])
def test_the_size_of_most_images_is_the_recordings(tmp_path, odd):
    entries = [ImageEntry(i, i / 10, tmp_path / f"{i}.png") for i in range(6)]
    for entry in entries:
        cv2.imwrite(str(entry.path), picture()[:: 1 + (entry.index == odd)])
    assert usual_size(entries, "here") == picture().shape[1::-1]
    for i in range(6):
        cv2.imwrite(str(entries[i].path), picture()[: 32 + i])
    with pytest.raises(SourceError, match="here: images of several sizes"):
        usual_size(entries, "here")
