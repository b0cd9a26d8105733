"""An emulated drone on free ports, its image, and the commands it received."""

import threading
import time
from contextlib import contextmanager

import numpy as np
from free_ports import free_ports

from edgeslam_torch.drone.emulator.drone import DroneModel, Mode
from edgeslam_torch.drone.emulator.link import LinkFaults
from edgeslam_torch.drone.emulator.server import EmulatorConfig, TelloEmulator

PATIENCE_S = 120.0
"""Time-out for expected events on a busy machine; passing tests wait far less."""


class SwiftDrone(DroneModel):
    """Simulated at four times real time to shorten the tests."""

    def step(self, dt):
        for _ in range(4):
            super().step(dt)


@contextmanager
def emulated(drone=None, render=None, **link):
    """An emulator with a textured picture and the address to record from; ``emulator.heard`` lists its commands."""
    state, video = free_ports(2)
    faults = LinkFaults(**({"video_latency_s": 0.02} | link))
    config = EmulatorConfig(command_port=0, state_port=state, video_port=video, width=320, height=240, link=faults)
    with TelloEmulator(config, render or speckled(), drone or SwiftDrone()) as emulator:
        emulator.heard = []
        listen_in(emulator, lambda text: None)
        yield emulator, f"tello://127.0.0.1:{emulator.command_port}:{state}:{video}"


def listen_in(emulator, hear):
    """Call ``hear`` with each command before it is carried out; it is lost on the air when that gives a reply."""
    run = emulator.interpreter.run

    def listening(text):
        lost = hear(text)
        if lost is not None:
            return lost
        emulator.heard.append(text)
        return run(text)

    emulator.interpreter.run = listening


def speckled():
    """A wall of blobs that moves with the drone."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.integers(0, 256, (60, 80), dtype=np.uint8), np.ones((8, 8), np.uint8))

    def render(T_w_b):
        row, column = (int(np.clip(100 + 100 * x, 0, n)) for x, n in ((T_w_b[2, 3], 240), (T_w_b[1, 3], 320)))
        return np.repeat(wall[row : row + 240, column : column + 320, None], 3, axis=2)

    return render


def until(condition, seconds=PATIENCE_S):
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "not in time"
        threading.Event().wait(0.01)


def on_the_floor(emulator):
    return emulator.drone.mode is Mode.GROUND
