"""A flight on a simulated clock: what it depends on, and what a recording of it holds."""

import csv

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.errors import OutputError
from edgeslam_torch.flying import lockstep_vehicle
from edgeslam_torch.flying.navigator import Navigator
from edgeslam_torch.flying.recorder import MOMENTS
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.readers.source import open_source

DRONES = []


class Truth:
    """Eyes that know the newest emulated drone."""

    def __init__(self, *unused):
        self.samples = []

    def add_telemetry(self, sample):
        self.samples.append(sample)

    def seen(self, image, arrived_s, captured_s):
        assert arrived_s - captured_s == pytest.approx(0.35)

    def state(self, now_s, view=None):
        d = DRONES[-1]
        return DroneState(now_s, d.p_w.copy(), d.yaw, d.velocity.copy(), battery=self.samples[-1].battery)

    def close(self):
        pass


@pytest.fixture(autouse=True)
def knowing(monkeypatch):
    """Ground truth perception and empty images."""
    drone_at = lockstep_vehicle.drone_at

    def unpainted(*arguments, **options):
        drone, _, camera = drone_at(*arguments, **options)
        DRONES.append(drone)
        return drone, lambda T_w_b: np.full((360, 480, 3), 90, np.uint8), camera

    monkeypatch.setattr(lockstep_vehicle, "SlamPerception", Truth)
    monkeypatch.setattr(lockstep_vehicle, "drone_at", unpainted)


def flown(record=None):
    """Up and down; returns the drone and when it stood."""
    with Navigator.open("sim://blank_walls:1", allow_motion=True, record=record) as nav:
        assert nav.take_off().reached
        assert nav.vehicle.tello.drone.p_w[2] == pytest.approx(nav.limits.height_m, abs=0.1)
        assert nav.land().reached
        return nav.vehicle.tello.drone, nav.vehicle.tello.clock_s


@pytest.mark.slow
def test_up_and_down_the_same_twice():
    (first, first_s), (second, second_s) = flown(), flown()
    assert first.mode is Mode.GROUND and not first.contacts
    assert first_s == second_s and first.p_w.tolist() == second.p_w.tolist()


def test_a_recording_holds_pictures_state_and_every_order(tmp_path):
    _, until_s = flown(tmp_path / "flight")
    source = open_source(str(tmp_path / "flight"))
    frames = list(source.frames())
    assert len(frames) == pytest.approx(15 * until_s, rel=0.1) and len(source.telemetry) > 5 * until_s
    with (tmp_path / "flight" / MOMENTS).open() as file:
        rows = list(csv.DictReader(file))
    assert {row["phase"] for row in rows} >= {"flying", "done"}
    rising = [float(row["z_m"]) for row in rows if row["phase"] == "flying"]
    assert rising[-1] > rising[0] + 0.1 and float(rows[0]["up_m_s"]) > 0.1
    with pytest.raises(OutputError, match="holds"):
        Navigator.open("sim://blank_walls:1", record=tmp_path / "flight")
