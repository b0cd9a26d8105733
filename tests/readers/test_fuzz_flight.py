"""Fuzzed flight folders (truncated, damaged, foreign files) and fuzzed answers of a drone."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edgeslam_torch.drone.answers import belongs_to, is_refusal
from edgeslam_torch.drone.emulator.commands import Interpreter
from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import Frame
from edgeslam_torch.writers.flight_writer import FlightWriter


@pytest.fixture(scope="module")
def flight(tmp_path_factory, request):
    """A recording of three pictures, as `edgeslam record` leaves it."""
    import numpy as np

    folder = tmp_path_factory.mktemp("fuzz") / "flight"
    camera = PRESETS["tello"].scaled(64, 48)
    with FlightWriter(folder, camera, with_telemetry=True) as writer:
        for k in range(3):
            writer.add_frame(Frame(k, 100.0 + 0.1 * k, np.full((48, 64, 3), 60 * k, np.uint8)))
            writer.add_state(StateMessage(100.0 + 0.1 * k, "vgx:1;tof:80;bat:90;", {"vgx": 1.0, "tof": 80.0}))
    return folder


def opens_or_refuses(folder):
    try:
        source = open_source(folder)
        stamps = [frame.stamp_s for frame in source.frames()]
        told = [sample.stamp_s for sample in source.telemetry]
    except EdgeSlamError as error:
        assert 0 < len(str(error)) < 2000
        return
    assert all(b > a for a, b in zip(stamps, stamps[1:], strict=False))
    assert told == sorted(told)


def damaged(flight, name, data):
    path = flight / name
    whole = path.read_bytes()
    path.write_bytes(data)
    try:
        opens_or_refuses(flight)
    finally:
        path.write_bytes(whole)


@pytest.mark.slow
@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(name=st.sampled_from(["rgb.txt", "camera.yaml", "telemetry.csv", "state.txt"]), share=st.floats(0.0, 1.0))
def test_a_flight_cut_off_anywhere(flight, name, share):
    whole = (flight / name).read_bytes()
    damaged(flight, name, whole[: int(share * len(whole))])


COMMANDS = st.sampled_from(["takeoff", "land", "go 20 0 0 30", "battery?", "attitude?", "sn?", "wifi?", "command"])


@pytest.mark.slow
@settings(max_examples=1000, deadline=None)
@given(
    command=COMMANDS, answer=st.one_of(st.text(max_size=60), st.binary(max_size=60).map(lambda b: b.decode("latin1")))
)
def test_answers_belong_or_do_not(command, answer):
    if belongs_to(command, answer) and not is_refusal(answer) and not command.endswith("?"):
        assert answer.lower().startswith(("ok", "forced stop"))


@pytest.mark.slow
@settings(max_examples=1000, deadline=None)
@given(lines=st.lists(st.one_of(st.text(max_size=40), COMMANDS), max_size=6))
def test_conversations_are_answered_in_the_drones_own_words(lines):
    interpreter = Interpreter(DroneModel())
    interpreter.run("command")
    for line in lines:
        reply = interpreter.run(line)
        if reply.text and line.strip() and line == line.strip() and line.isascii() and line.isprintable():
            assert belongs_to(line, reply.text.strip()), (line, reply.text)
        interpreter.drone.step(0.05)
