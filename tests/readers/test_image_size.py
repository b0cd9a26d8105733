"""The size in an image's header equals the decoded size."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeslam_torch.readers.image_size import image_size

WRITTEN = {
    "a.png": [],
    "a.jpg": [],
    "progressive.jpg": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    "a.bmp": [],
    "a.tiff": [],
    "a.ppm": [cv2.IMWRITE_PXM_BINARY, 0],
    "lossy.webp": [cv2.IMWRITE_WEBP_QUALITY, 80],
    "lossless.webp": [cv2.IMWRITE_WEBP_QUALITY, 101],
}


@pytest.mark.parametrize("name", WRITTEN)
def test_size_of_what_opencv_writes_even_where_it_is_cut_off(name):
    image = np.random.default_rng(0).integers(0, 256, (45, 67, 3), dtype=np.uint8)
    data = cv2.imencode(name[name.index(".") :], image, WRITTEN[name])[1].tobytes()
    assert image_size(data) == (67, 45)
    assert all(image_size(data[:n]) in (None, (67, 45)) for n in range(200))


@pytest.mark.parametrize(
    ("data", "size"),
    [
        (b"P5 # a comment\n 12\n# another 7\n34 255\n", (12, 34)),
        (b"BM" + bytes(12) + (12).to_bytes(4, "little") + b"\x40\x00\x30\x00" + bytes(40), (64, 48)),
        (b"BM" + bytes(12) + (40).to_bytes(4, "little") + b"\x40\0\0\0" + b"\xd0\xff\xff\xff" + bytes(40), (64, 48)),
        (b"RIFF....WEBPVP8X" + bytes(8) + b"\x3f\0\0\x2f\0\0", (64, 48)),
        (b"\xff\xd8\xff\xff\xff\xe0\0\x04..\xff\xc2\0\x11\x08\0\x30\0\x40", (64, 48)),
        (
            b"MM\0*\0\0\0\x08\0\x02" + b"\x01\0\0\x03\0\0\0\x01\0\x40\0\0" + b"\x01\x01\0\x04\0\0\0\x01\0\0\0\x30",
            (64, 48),
        ),
        (b"GIF89a" + bytes(20), None),
        (b"", None),
    ],
)
def test_size_by_the_formats_own_words(data, size):
    assert image_size(data) == size


@given(
    st.sampled_from([b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"BM", b"II*\0", b"MM\0*", b"RIFF0000WEBPVP8", b"P5 ", b""]),
    st.binary(max_size=80),
)
def test_any_bytes_have_a_size_or_none(begin, rest):
    size = image_size(begin + rest)
    assert size is None or min(size) >= 0
