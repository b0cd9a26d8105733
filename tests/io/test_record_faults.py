"""``edgeslam record`` in bad air: it ends by itself, says why, leaves the drone on the floor and a flight that runs.

Nothing here asserts how long anything takes; what must happen in the end is waited for.
"""

import json
import threading
from contextlib import closing, contextmanager

import numpy as np
import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.emulator.drone import DroneModel, Mode
from edgeslam_torch.emulator.link import LinkFaults
from edgeslam_torch.emulator.server import EmulatorConfig, TelloEmulator
from edgeslam_torch.io.source import open_source
from edgeslam_torch.io.tello_video import open_udp

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")
PATIENCE_S = 120.0


class SwiftDrone(DroneModel):
    """Lives four times as fast."""

    def step(self, dt):
        for _ in range(4):
            super().step(dt)


@contextmanager
def emulated(**link):
    """An emulator with a textured picture and the address to record from."""
    ports = []
    for _ in range(2):
        with open_udp(("127.0.0.1", 0), "free") as udp:
            ports.append(udp.getsockname()[1])
    faults = LinkFaults(video_latency_s=0.02, **link)
    config = EmulatorConfig(
        command_port=0, state_port=ports[0], video_port=ports[1], width=320, height=240, link=faults
    )
    with TelloEmulator(config, render=speckled(), drone=SwiftDrone()) as emulator:
        yield emulator, f"tello://127.0.0.1:{emulator.command_port}:{ports[0]}:{ports[1]}"


def speckled():
    """A wall of blobs that moves with the drone."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.integers(0, 256, (60, 80), dtype=np.uint8), np.ones((8, 8), np.uint8))

    def render(T_w_b):
        row, column = (int(np.clip(100 + 100 * x, 0, n)) for x, n in ((T_w_b[2, 3], 240), (T_w_b[1, 3], 320)))
        return np.repeat(wall[row : row + 240, column : column + 320, None], 3, axis=2)

    return render


@contextmanager
def meanwhile(work):
    """``work(stop)`` in a thread beside the block."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)


def wait_until(condition, stop):
    while not condition() and not stop.wait(0.02):
        pass


def landed(emulator):
    """Whether the drone comes to stand; one that hears nothing comes down by itself."""
    stop = threading.Event()
    timer = threading.Timer(PATIENCE_S, stop.set)
    timer.start()
    wait_until(lambda: emulator.drone.mode is Mode.GROUND, stop)
    timer.cancel()
    return emulator.drone.mode is Mode.GROUND


def check_flight(folder, tmp_path, least_frames):
    """Every frame and message that was listed is there, and ``edgeslam run`` takes the folder."""
    source = open_source(folder)
    with closing(source):
        frames = list(source.frames())
        listed = [line for line in (folder / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
        assert len(frames) == len(listed) >= least_frames
        assert not source.problems
        assert len(source.telemetry) == (folder / "state.txt").read_text().count("\n") > 0
    assert all(np.diff([f.stamp_s for f in frames]) > 0)
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out), "--max-frames", "30", "--no-report", "--no-progress"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == min(30, len(frames))
    return frames


@pytest.mark.slow
def test_one_packet_in_twenty_lost(tmp_path, capsys):
    with emulated(loss=0.05) as (emulator, url):
        code = main(["record", url, "--out", str(tmp_path / "flight"), "--fly", "--max-frames", "150"])
        assert landed(emulator)
    said = capsys.readouterr()
    assert code == 0 or "no answer" in said.err or "ended" in said.out
    assert "frames," in said.out
    check_flight(tmp_path / "flight", tmp_path, 30)


@pytest.mark.slow
def test_an_outage_of_three_seconds(tmp_path, capsys):
    with emulated() as (emulator, url):

        def cut(stop):
            wait_until(lambda: emulator.drone.mode is Mode.FLYING, stop)
            emulator.link.cut = True
            stop.wait(3.0)
            emulator.link.cut = False

        with meanwhile(cut):
            code = main(["record", url, "--out", str(tmp_path / "flight"), "--fly", "--max-frames", "200"])
        assert landed(emulator)
    said = capsys.readouterr()
    assert code == 0 or "no answer" in said.err or "ended" in said.err
    frames = check_flight(tmp_path / "flight", tmp_path, 60)
    gap = int(np.argmax(np.diff([f.stamp_s for f in frames])))
    assert frames[gap + 1].stamp_s - frames[gap].stamp_s > 2.0
    assert gap + 2 < len(frames)  # it went on


@pytest.mark.slow
def test_a_drone_that_stops_answering(tmp_path, capsys):
    with emulated() as (emulator, url):

        def freeze(stop):
            wait_until(lambda: emulator.drone.mode is Mode.FLYING, stop)
            emulator.frozen = True

        with meanwhile(freeze):
            main(["record", url, "--out", str(tmp_path / "flight"), "--fly"])
        assert landed(emulator)
    said = capsys.readouterr()
    assert "the flight was ended: no " in said.out
    assert "no picture for 10 s" in said.out or "ended" in said.err
    check_flight(tmp_path / "flight", tmp_path, 5)


@pytest.mark.slow
def test_garbage_on_every_port(tmp_path, capsys):
    with emulated(garbage=0.2) as (emulator, url):
        ports = [int(port) for port in url.rsplit(":", 3)[1:]]

        def shout(stop):
            rng = np.random.default_rng(1)
            with open_udp(("127.0.0.1", 0), "noise") as udp:
                while not stop.wait(0.02):
                    for port in ports:
                        udp.sendto(rng.bytes(int(rng.integers(1, 1400))), ("127.0.0.1", port))

        with meanwhile(shout):
            code = main(["record", url, "--out", str(tmp_path / "flight"), "--fly", "--max-frames", "100"])
        assert landed(emulator)
    said = capsys.readouterr()
    assert code == 0 or "no answer" in said.err or "ended" in said.out + said.err
    check_flight(tmp_path / "flight", tmp_path, 30)


@pytest.mark.slow
def test_a_drone_that_is_not_there(tmp_path, capsys):
    with emulated() as (emulator, url):
        emulator.frozen = True
        assert main(["record", url, "--out", str(tmp_path / "flight"), "--fly"]) == 1
    assert "is the drone on" in capsys.readouterr().err
    assert not (tmp_path / "flight" / "rgb.txt").exists()
