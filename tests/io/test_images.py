"""Frames of image files."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.io.images import frames_of, read_frame, read_image
from edgeslam_torch.io.listing import ImageEntry


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


def test_a_grey_jpeg_stays_grey(entry):
    frame = read_frame(entry("a.jpg", picture()[:, :, 0]))
    np.testing.assert_array_equal(frame.image, frame.grey)


def test_another_format_is_decoded_once(entry):
    frame = read_frame(entry("a.png", picture()))
    np.testing.assert_array_equal(frame.image, picture())
    assert frame.grey is None


def test_a_jpeg_that_is_none_or_of_another_size_is_left_out(entry, tmp_path):
    good, small = entry("a.jpg", picture()), entry("b.jpg", picture()[:40])
    broken, cut = tmp_path / "c.jpg", tmp_path / "d.jpg"
    broken.write_bytes(b"\xff\xd8 no image \xff\xd9")
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


def test_missing_file_is_said(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        read_frame(ImageEntry(0, 0.0, tmp_path / "none.jpg"))
