"""Every way out of ``edgeslam record --fly`` ends with the drone on the floor, because it was told to land.

The program is a process of its own, as a user starts it; a drone that comes down by itself after 15 s of silence does
not count.
"""

import os
import pty
import re
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from emulated import SwiftDrone, emulated, listen_in, on_the_floor, speckled, until

from edgeslam_torch.drone.emulator.commands import Answer, Reply
from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.readers.source import open_source

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.alone,
    pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them"),
]

LOST = Reply("", Answer.NEVER)
POLITE = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT]


@contextmanager
def recording(url, folder, before=lambda: None, **streams):
    """``edgeslam record --fly`` in a process of its own, killed at the end if it still runs."""
    command = [sys.executable, "-m", "edgeslam_torch.cli", "record", url, "--out", str(folder), "--fly"]

    def prepare():
        for number in POLITE:  # whatever the tests themselves were started with
            signal.signal(number, signal.SIG_DFL)
        before()

    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    with subprocess.Popen(command, text=True, preexec_fn=prepare, **streams) as process:
        try:
            yield process
        finally:
            process.kill()


def flying(emulator):
    return emulator.drone.mode is Mode.FLYING and emulator.drone.p_w[2] > 0.5


def check_landed(emulator):
    until(lambda: on_the_floor(emulator))
    assert "land" in emulator.heard


def check_folder(folder):
    """What is listed is there and can be read."""
    source = open_source(folder)
    frames = list(source.frames())
    assert len(frames) == (folder / "rgb.txt").read_text().count(".jpg\n") > 0
    assert not source.problems
    assert len(source.telemetry) == (folder / "state.txt").read_text().count("\n") > 0
    return len(frames)


class SlowStarter(SwiftDrone):
    """Its rotors spin up for two seconds after ``takeoff``; until then it reports to be on the floor."""

    spin_up_s = 0.0

    def take_off(self):
        self.spin_up_s = 8.0  # it runs four times as fast
        return super().take_off()

    def step(self, dt):
        if self.spin_up_s > 0:
            self.spin_up_s -= 4 * dt
        else:
            super().step(dt)


def test_a_signal_before_take_off_is_answered(tmp_path):
    """The drone has heard ``takeoff``, still stands on the floor, and refuses to land until it is up."""
    refused = []

    def refuse(text):
        if text == "land" and emulator.drone.spin_up_s > 0:
            refused.append(text)
            return Reply("error")
        return None

    with emulated(SlowStarter()) as (emulator, url), recording(url, tmp_path / "flight") as process:
        listen_in(emulator, refuse)
        until(lambda: "takeoff" in emulator.heard)
        process.send_signal(signal.SIGTERM)
        process.communicate()
        assert on_the_floor(emulator)
        assert refused
        assert "land" in emulator.heard
    assert process.returncode == 128 + signal.SIGTERM


def test_ctrl_c_again_and_again_does_not_end_the_landing(tmp_path):
    """The first three ``land`` are lost, and after each the user presses Ctrl-C."""
    lost = []

    def impatient(text):
        if text == "land" and len(lost) < 3:
            lost.append(text)
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGINT)
            return LOST
        return None

    with emulated() as (emulator, url), recording(url, tmp_path / "flight") as process:
        until(lambda: flying(emulator))
        listen_in(emulator, impatient)
        process.send_signal(signal.SIGINT)
        process.communicate()
        assert on_the_floor(emulator)
        assert "land" in emulator.heard
    assert len(lost) == 3
    assert process.returncode == 130
    check_folder(tmp_path / "flight")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_program_that_is_shot_still_lands(tmp_path, number):
    with emulated() as (emulator, url), recording(url, tmp_path / "flight") as process:
        until(lambda: flying(emulator))
        process.send_signal(number)
        process.communicate()  # its guard holds no pipe of ours open
        assert process.returncode == -number
        check_landed(emulator)
    check_folder(tmp_path / "flight")


def test_a_program_that_is_stopped_is_landed_and_finds_its_flight_ended(tmp_path):
    """Ctrl-Z stops the program that controls the drone."""
    with emulated() as (emulator, url), recording(url, tmp_path / "flight") as process:
        until(lambda: flying(emulator))
        process.send_signal(signal.SIGSTOP)
        check_landed(emulator)
        process.send_signal(signal.SIGCONT)
        _, errors = process.communicate()
    assert process.returncode == 1
    assert "the flight was ended: " in errors.splitlines()[-1]
    check_folder(tmp_path / "flight")


def test_the_terminal_is_closed(tmp_path):
    """The system sends SIGHUP, and whatever is printed from then on fails."""
    ours, theirs = pty.openpty()

    def take_terminal():
        os.setsid()
        os.close(os.open(os.ttyname(0), os.O_RDWR))  # the first terminal that a session opens is its own

    with (
        emulated() as (emulator, url),
        recording(url, tmp_path / "flight", take_terminal, stdin=theirs, stdout=theirs, stderr=theirs) as process,
    ):
        os.close(theirs)
        until(lambda: flying(emulator))
        os.close(ours)
        process.wait()
        assert on_the_floor(emulator)
        assert "land" in emulator.heard
    assert process.returncode == 128 + signal.SIGHUP
    check_folder(tmp_path / "flight")


def test_the_disk_fills_up_in_flight(tmp_path):
    """Pictures from above half a metre are noise and larger than what the disk takes."""
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    wall = speckled()

    def render(T_w_b):
        return noise if T_w_b[2, 3] > 0.5 else wall(T_w_b) // 8

    def small_disk():
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))

    with emulated(render=render) as (emulator, url), recording(url, tmp_path / "flight", small_disk) as process:
        said, errors = process.communicate()
        assert on_the_floor(emulator)
        assert "land" in emulator.heard
    assert process.returncode == 1
    assert re.fullmatch(r"edgeslam: error: .*/rgb/.*\.jpg: cannot be written: File too large\n", errors)
    frames = check_folder(tmp_path / "flight")
    assert f"{frames} frames" in said
    assert len(list((tmp_path / "flight" / "rgb").iterdir())) == frames
