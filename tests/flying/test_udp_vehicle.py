"""Threads of a flight over UDP, against an emulator with ground truth perception."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from emulated import SwiftDrone, emulated, until

from edgeslam_torch.cli import main
from edgeslam_torch.drone import video_stream
from edgeslam_torch.drone.address import TelloAddress
from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.flying import udp_vehicle
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.flying.navigator import Navigator
from edgeslam_torch.flying.result import FlightRefused
from edgeslam_torch.navigation.drone_state import DroneState, VelocityCommand
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import Phase
from edgeslam_torch.navigation.supervisor import Danger
from edgeslam_torch.readers.source import open_source

pytest.importorskip("av")


class Truth:
    """Eyes that know the emulated drone."""

    drone = SwiftDrone()
    battery = 1.0
    tracked = True

    def __init__(self, *unused, **unused_too):
        self.told_by, self.seen_s = set(), []

    def add_telemetry(self, sample):
        self.told_by.add(threading.current_thread())

    def seen(self, *unused):
        self.seen_s.append(time.monotonic())

    def state(self, now_s, view=None):
        d = self.drone
        moved = np.array([0.2, 0.0, 0.0])  # as if it moved: what is commanded here is not for long
        return DroneState(now_s, d.p_w.copy(), d.yaw, moved, battery=type(self).battery, tracked=type(self).tracked)

    def close(self):
        pass


class Steady:
    """A planner with one command, or one that hangs."""

    def __init__(self):
        self.command, self.phase, self.layer, self.result = VelocityCommand(forward_m_s=0.3), Phase.FLYING, None, None
        self.go_on = threading.Event()
        self.go_on.set()

    def begin(self, skill):
        self.result = None

    def update(self, state):
        self.go_on.wait(60.0)
        return self.command


@pytest.fixture
def flight(monkeypatch):
    """An emulator, and a navigator whose planner commands forward flight."""
    monkeypatch.setattr(udp_vehicle, "SlamPerception", Truth)
    monkeypatch.setattr(Truth, "battery", 1.0)
    monkeypatch.setattr(Truth, "tracked", True)
    drone = SwiftDrone()
    monkeypatch.setattr(Truth, "drone", drone)
    with emulated(drone) as (emulator, location):
        flight_controller = FlightController(NavLimits())
        flight_controller.pilot = Steady()
        vehicle = udp_vehicle.UdpVehicle(TelloAddress.parse(location), flight_controller, True, camera="tello")
        try:
            yield emulator, vehicle, flight_controller
        finally:
            flight_controller.pilot.go_on.set()
            vehicle.close()


def test_perception_has_attitude_before_the_first_picture_and_runs_at_15_hz(flight):
    _, vehicle, _ = flight
    perception = vehicle._perception
    assert threading.current_thread() in perception.told_by, "while they were opened: the next message may be late"
    until(lambda: len(perception.seen_s) > 6)
    assert min(np.diff(perception.seen_s)) > 0.9 / 15.0, "of thirty that are sent"


def forward(emulator):
    return emulator.drone.rc[1]


def test_planner_and_supervisor_fly_and_a_hung_planner_is_stopped(flight):
    emulator, vehicle, flight_controller = flight
    vehicle.take_off()
    until(lambda: forward(emulator) == pytest.approx(0.3))
    flight_controller.pilot.go_on.clear()
    until(lambda: emulator.drone.rc == (0.0, 0.0, 0.0, 0.0))
    until(lambda: flight_controller.last.danger is Danger.NO_COMMAND)
    flight_controller.pilot.go_on.set()
    until(lambda: forward(emulator) == pytest.approx(0.3))
    flight_controller.land("as commanded")
    vehicle.fly(lambda: False)
    assert vehicle.over == "as commanded" and not vehicle.flying
    until(lambda: emulator.drone.mode is Mode.GROUND)


def test_an_empty_battery_lands_it(flight, monkeypatch):
    emulator, vehicle, _ = flight
    vehicle.take_off()
    monkeypatch.setattr(Truth, "battery", 0.08)
    vehicle.fly(lambda: False)
    assert vehicle.over == str(Danger.BATTERY)
    until(lambda: emulator.drone.mode is Mode.GROUND)


def test_a_supervisor_that_fails_lands_it(flight, monkeypatch):
    emulator, vehicle, flight_controller = flight
    vehicle.take_off()
    monkeypatch.setattr(flight_controller, "order", lambda state: 1 / 0)
    vehicle.fly(lambda: False)
    assert "failed" in vehicle.over
    until(lambda: emulator.drone.mode is Mode.GROUND)


def test_leaving_lands_it(flight):
    emulator, vehicle, _ = flight
    vehicle.take_off()
    vehicle.close()
    assert vehicle.over == "the program left"
    until(lambda: emulator.drone.mode is Mode.GROUND)


def test_another_resolution_in_mid_stream_lands_it(flight, monkeypatch):
    emulator, vehicle, _ = flight
    vehicle.take_off()
    monkeypatch.setattr(video_stream, "_OTHER_SIZE_S", 0.1)
    vehicle._one_size.size = (960, 720)
    vehicle.fly(lambda: False)
    assert "resolution" in vehicle.over
    until(lambda: emulator.drone.mode is Mode.GROUND)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_a_signal_ends_a_flight_in_order(tmp_path, monkeypatch, capsys, name):
    monkeypatch.setattr(udp_vehicle, "SlamPerception", Truth)
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)
    monkeypatch.setattr(Truth, "drone", SwiftDrone())
    in_the_air = threading.Thread(
        target=lambda: (until(lambda: Truth.drone.p_w[2] > 0.95), os.kill(os.getpid(), number))
    )
    try:
        with emulated(Truth.drone) as (emulator, location):
            in_the_air.start()
            options = ["--fly", "--drone", location, "--camera", "tello", "--record", str(tmp_path / "flight")]
            assert main(["fly", "home", *options]) == 128 + number
            assert emulator.drone.mode is Mode.GROUND and "land" in emulator.heard
    finally:
        in_the_air.join()
        signal.signal(number, before)
    said = capsys.readouterr().out
    assert f"by {name}" in said and "recorded:" in said
    recorded = open_source(tmp_path / "flight")
    assert len(list(recorded.frames())) > 0 and not recorded.problems


def test_nothing_moves_without_leave(monkeypatch):
    monkeypatch.setattr(udp_vehicle, "SlamPerception", Truth)
    with emulated() as (emulator, location), Navigator.open(location, camera="tello") as nav:
        with pytest.raises(FlightRefused, match="--fly"):
            nav.take_off()
        with pytest.raises(FlightRefused, match="take off first"):
            nav.go_to((1.0, 0.0, 1.15))
        with pytest.raises(FlightRefused, match="not flying"):
            nav.land()
    moving = ("takeoff", "rc", "land", "go", "up", "forward")
    assert not [text for text in emulator.heard if text.split()[0] in moving]


def test_an_unknown_camera_does_not_fly(monkeypatch):
    monkeypatch.setattr(udp_vehicle, "SlamPerception", Truth)
    with (
        emulated() as (_, location),
        Navigator.open(location, allow_motion=True) as nav,
        pytest.raises(FlightRefused, match="calibration"),
    ):
        nav.take_off()


@pytest.mark.parametrize(
    ("hz", "seconds", "warns"), [(15, 30, False), (6, 30, False), (3, 30, True), (0.2, 30, True), (3, 9, False)]
)
def test_a_computer_too_slow_for_the_flight_is_named_with_its_rate(hz, seconds, warns):
    said = udp_vehicle.too_slow(np.arange(0, seconds, 1 / hz).tolist())
    assert (f" {hz:.1f} pictures" in said) == warns == bool(said)


def test_it_is_said_once_in_flight(flight, monkeypatch, caplog):
    _, vehicle, _ = flight
    monkeypatch.setattr(udp_vehicle, "_SLOW_S", 0.5)
    monkeypatch.setattr(udp_vehicle, "_SLOW_HZ", 1000.0)
    before = len(vehicle._perception.seen_s)
    until(lambda: len(vehicle._perception.seen_s) > before + 10)
    assert not caplog.records, "on the ground"
    vehicle.take_off()
    until(lambda: caplog.records)
    before = len(vehicle._perception.seen_s)
    until(lambda: len(vehicle._perception.seen_s) > before + 20)
    assert len(caplog.records) == 1
