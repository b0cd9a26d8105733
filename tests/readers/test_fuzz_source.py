"""Whatever lies in a folder: a source, or one of our errors with one line; never another exception."""

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.readers.source import open_source

NUMBERS = st.one_of(st.integers(), st.floats(), st.text(max_size=8)).map(str)
LISTS = st.lists(
    st.one_of(
        st.tuples(NUMBERS, st.sampled_from(["1.png", "2.png", "bad.png", "../..", "/", "x" * 300, "\0"])).map(" ".join),
        st.text(max_size=20),
    ),
    max_size=8,
).map("\n".join)
VALUES = st.one_of(
    NUMBERS,
    st.sampled_from([".inf", ".nan", "-1", "640", "480", "1e400", "[]", "{}", "null", "pinhole", "[1, 2, 3, 4]"]),
)
OURS = ("width", "height", "fx", "fy", "cx", "cy", "distortion", "model")
ROS = ("image_width", "image_height", "camera_matrix", "distortion_coefficients", "distortion_model")
EUROC = ("resolution", "intrinsics", "distortion_coefficients", "distortion_model")
CALIBRATIONS = st.one_of(
    st.sampled_from([OURS, ROS, EUROC]).flatmap(
        lambda keys: st.lists(VALUES, min_size=len(keys), max_size=len(keys)).map(
            lambda values: "\n".join(f"{key}: {value}" for key, value in zip(keys, values, strict=True))
        )
    ),
    st.text(max_size=60),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    for name in ("1.png", "2.png"):
        cv2.imwrite(str(folder / name), np.full((48, 64), 90, np.uint8))
    (folder / "bad.png").write_bytes(b"bad")
    return folder


def use(folder):
    """Open and read; an error must be ours and fit one line."""
    try:
        source = open_source(folder)
        stamps = [frame.stamp_s for frame in source.frames()]
    except EdgeSlamError as error:
        assert len(str(error)) < 2000
        return
    assert all(b > a for a, b in zip(stamps, stamps[1:], strict=False))


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=LISTS)
def test_any_image_list(folder, text):
    (folder / "rgb.txt").write_text(text, encoding="utf-8", errors="surrogatepass")
    use(folder)
    (folder / "rgb.txt").unlink()


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=CALIBRATIONS)
def test_any_calibration(folder, text):
    (folder / "camera.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
    use(folder)
    (folder / "camera.yaml").unlink()


@pytest.mark.slow
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200), name=st.sampled_from(["rgb.txt", "camera.yaml", "2.png"]))
def test_any_bytes(folder, data, name):
    old = (folder / name).read_bytes() if (folder / name).exists() else None
    (folder / name).write_bytes(data)
    use(folder)
    if old is None:
        (folder / name).unlink()
    else:
        (folder / name).write_bytes(old)
