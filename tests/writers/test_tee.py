"""A live source and its recording give the same frames, bit for bit."""

import numpy as np
import pytest
from fake_feed import FakeFeed
from free_ports import free_ports

from edgeslam_torch.cli import main
from edgeslam_torch.drone.emulator.link import LinkFaults
from edgeslam_torch.drone.emulator.server import EmulatorConfig, TelloEmulator
from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.readers.live import LiveSource, open_tello
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.writers import flight_writer, tee
from edgeslam_torch.writers.tee import RecordedLive

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")


@pytest.fixture
def address():
    state, video = free_ports(2)
    config = EmulatorConfig(
        command_port=0, state_port=state, video_port=video, width=160, height=120, link=LinkFaults(video_latency_s=0.02)
    )
    with TelloEmulator(config) as emulator:
        yield f"tello://127.0.0.1:{emulator.command_port}:{state}:{video}"


def test_a_recorded_live_source_gives_again_what_it_gave(address, tmp_path):
    source, _ = open_tello(address, max_frames=25)
    live = RecordedLive(source, tmp_path / "flight", lossless=True)
    seen = list(live.frames())
    assert not live.problems
    again = open_source(tmp_path / "flight")
    for was, now in zip(seen, again.frames(), strict=True):
        assert now.stamp_s == was.stamp_s
        np.testing.assert_array_equal(now.image, was.image)
    assert len(again.telemetry) == len(live.telemetry) > 0
    for sample, told in zip(again.telemetry, live.telemetry, strict=True):
        assert sample.stamp_s == told.stamp_s
        np.testing.assert_array_equal(sample.velocity_m_s, told.velocity_m_s)
        np.testing.assert_array_equal(sample.rpy_rad, told.rpy_rad)
        assert sample.tof_m == told.tof_m
    assert again.camera.K.tolist() == live.camera.K.tolist()


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), RuntimeError("bug")])
@pytest.mark.parametrize("kind", ["FlightWriter.add_frame", "TelemetryWriter.write"])
def test_a_writer_that_fails_ends_the_recording_and_not_the_flight(tmp_path, monkeypatch, kind, failure):
    """More frames than the queue holds: a writer that has died does not block the caller."""
    monkeypatch.setattr(tee, "_WAITING", 3)
    owner, name = kind.split(".")
    write, calls = getattr(getattr(flight_writer, owner), name), []

    def fail(self, *args):
        calls.append(name)
        if len(calls) > 5:
            raise failure
        return write(self, *args)

    monkeypatch.setattr(getattr(flight_writer, owner), name, fail)
    feed = FakeFeed(range(1, 41))
    messages = [StateMessage(0.1 * count, "bat:90;", {"bat": 90.0}) for count in range(1, 41)]
    source = LiveSource("tello://test", feed, None, 40, [], messages)
    live = RecordedLive(source, tmp_path / "flight", lossless=False)
    assert len(list(live.frames())) == 40
    assert feed.closed
    assert len(live.problems) == 1
    assert str(failure.args[-1]) in live.problems[0].reason
    again = open_source(tmp_path / "flight")
    assert len(list(again.frames())) >= 1
    assert not again.problems


@pytest.mark.parametrize("name", ["rgb.txt", "moments.csv", "0.png"])
def test_a_folder_that_cannot_be_written_leaves_the_drone_alone(address, tmp_path, capsys, name):
    (tmp_path / name).write_text("")
    assert main(["run", address, "--record", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    assert name in capsys.readouterr().err


def test_a_recording_is_not_recorded_again(tmp_path, capsys):
    assert main(["run", str(tmp_path), "--record", str(tmp_path / "x")]) != 0
    assert "live sources" in capsys.readouterr().err
