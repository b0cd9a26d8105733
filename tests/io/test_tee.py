"""What was seen live and what its recording gives are the same, to the bit."""

import numpy as np
import pytest
from free_ports import free_ports

from edgeslam_torch.cli import main
from edgeslam_torch.emulator.link import LinkFaults
from edgeslam_torch.emulator.server import EmulatorConfig, TelloEmulator
from edgeslam_torch.io.live import open_tello
from edgeslam_torch.io.source import open_source
from edgeslam_torch.io.tee import RecordedLive

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
    source, _, messages = open_tello(address, max_frames=25)
    live = RecordedLive(source, messages, tmp_path / "flight", lossless=True)
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


def test_a_folder_that_cannot_be_written_leaves_the_drone_alone(address, tmp_path, capsys):
    (tmp_path / "rgb.txt").write_text("")
    assert main(["run", address, "--record", str(tmp_path), "--out", str(tmp_path / "run")]) == 1
    assert "holds a recording already" in capsys.readouterr().err


def test_a_recording_is_not_recorded_again(tmp_path, capsys):
    assert main(["run", str(tmp_path), "--record", str(tmp_path / "x")]) != 0
    assert "live sources" in capsys.readouterr().err
