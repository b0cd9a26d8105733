"""Whatever lies in a folder: a source, or one of our errors with one line; never another exception."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import Frame
from edgeslam_torch.writers.flight_writer import FlightWriter

NUMBERS = st.one_of(st.integers(), st.floats(), st.text(max_size=8)).map(str)
NAMES = st.sampled_from(["rgb/1.png", "rgb/2.png", "bad.png", "../..", "/", "x" * 300, "\0"])
LISTS = st.lists(st.one_of(st.tuples(NUMBERS, NAMES).map(" ".join), st.text(max_size=20)), max_size=8).map("\n".join)
FILES = ("rgb.txt", "camera.yaml", "telemetry.csv", "state.txt")


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A recording of three pictures, as `edgeslam record` leaves it, and the contents of its files."""
    folder = tmp_path_factory.mktemp("fuzz") / "flight"
    with FlightWriter(folder, PRESETS["tello"].scaled(64, 48), with_telemetry=True) as writer:
        for k in range(3):
            writer.add_frame(Frame(k, 100.0 + 0.1 * k, np.full((48, 64, 3), 60 * k, np.uint8)))
            writer.add_state(StateMessage(100.0 + 0.1 * k, "vgx:1;tof:80;bat:90;", {"vgx": 1.0, "tof": 80.0}))
    return folder, {name: (folder / name).read_bytes() for name in FILES}


DAMAGE = st.one_of(
    st.tuples(st.sampled_from(FILES), st.floats(0.0, 1.0)),  # cut off after this share
    st.tuples(st.just("rgb.txt"), LISTS),
    st.tuples(st.just("camera.yaml"), st.text(max_size=60)),
    st.tuples(st.sampled_from(FILES), st.binary(max_size=200)),
)


@pytest.mark.slow
@settings(max_examples=1500, suppress_health_check=list(HealthCheck))
@given(damage=DAMAGE)
def test_a_flight_is_read_or_refused_whatever_is_damaged(flight, damage):
    (folder, whole), (name, content) = flight, damage
    if isinstance(content, float):
        content = whole[name][: int(content * len(whole[name]))]
    elif isinstance(content, str):
        content = content.encode("utf-8", "surrogatepass")
    (folder / name).write_bytes(content)
    try:
        source = open_source(folder)
        stamps = [frame.stamp_s for frame in source.frames()]
        assert all(b > a for a, b in zip(stamps, stamps[1:], strict=False))
        told = [sample.stamp_s for sample in source.telemetry]
        assert told == sorted(told)
    except EdgeSlamError as error:
        assert 0 < len(str(error)) < 2000
    finally:
        (folder / name).write_bytes(whole[name])
