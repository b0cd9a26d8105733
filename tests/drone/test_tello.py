"""Our client against the emulator, on loopback and in real time; waiting is for conditions, not for times."""

import _thread
import importlib
import socket
import threading
from contextlib import closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from emulated import PATIENCE_S, SwiftDrone, emulated, listen_in, until
from free_ports import free_ports

import edgeslam_torch.drone.tello as tello_module
from edgeslam_torch.drone.answers import belongs_to
from edgeslam_torch.drone.emulator.commands import Answer, Reply
from edgeslam_torch.drone.emulator.drone import Mode
from edgeslam_torch.drone.emulator.encoder import Encoder
from edgeslam_torch.drone.tello import Tello, TelloAddress, TelloError, TelloLimits
from edgeslam_torch.drone.video_stream import PictureAssembler
from edgeslam_torch.errors import SourceError

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")
LOST = Reply("", Answer.NEVER)
QUICK = TelloLimits(timeout_s=1.0, retries=3, keep_alive_s=0.5, state_loss_s=PATIENCE_S, video_loss_s=3.0)


@contextmanager
def client(limits=None, drone=None, motion=False, host=None, link=None, **listeners):
    """An emulator and a client connected to it; the client ends, and lands, before the emulator does."""
    with emulated(drone, **(link or {})) as (emulator, url):
        address = TelloAddress.parse(url)
        address = replace(address, host=host or address.host)
        with Tello(address, allow_motion=motion, limits=limits or TelloLimits(), **listeners) as tello:
            tello.connect(PATIENCE_S)
            yield emulator, tello


@contextmanager
def flying(**options):
    with client(motion=True, **options) as (emulator, tello):
        tello.take_off()
        yield emulator, tello


def lose(emulator, command, count):
    """Let the next ``count`` packets with this command be lost; returns the list of those that were."""
    lost = []

    def hear(text):
        if text == command and len(lost) < count:
            lost.append(text)
            return LOST
        return None

    listen_in(emulator, hear)
    return lost


def test_state_and_video_of_a_restarted_drone_are_requested_again():
    with client() as (emulator, tello):
        video = tello.start_video()
        assert video.wait(0, PATIENCE_S) is not None
        emulator.heard.clear()
        emulator.interpreter.sdk_mode = emulator.interpreter.stream = False
        until(lambda: emulator.heard[:2] == ["command", "streamon"])
        until(lambda: tello.silences == 1)
        assert video.wait(video.newest.count, PATIENCE_S) is not None


def test_connects_flies_streams_and_lands():
    with flying() as (emulator, tello):
        video = tello.start_video()
        first = video.wait(0, PATIENCE_S)
        assert first.image.shape == (240, 320, 3)
        assert emulator.drone.mode is Mode.FLYING
        tello.move(0.4, 0.0, 0.2)
        np.testing.assert_allclose(emulator.drone.p_w, [0.4, 0.0, 1.1], atol=0.12)
        tello.turn(np.radians(30))
        assert np.degrees(emulator.drone.yaw) == pytest.approx(30, abs=5)
        tello.move(0.0, 0.4, 0.0)
        np.testing.assert_allclose(emulator.drone.p_w, [0.2, 0.35, 1.1], atol=0.15)
        with pytest.raises(TelloError, match="'go 5 0 0 40' was refused: out of range"):
            tello.move(0.05, 0.0, 0.0)
        assert tello.query("battery?") == pytest.approx(100.0, abs=1.0)
        until(lambda: video.newest.count > first.count + 20)
        until(lambda: tello.latest.sample().tof_m > 0.8)
    assert emulator.drone.mode is Mode.GROUND


def test_nothing_moves_unless_it_was_allowed():
    with client() as (emulator, tello):
        for move in (tello.take_off, lambda: tello.rc(0, 1, 0, 0), lambda: tello.send("motoron")):
            with pytest.raises(TelloError, match="--fly"):
                move()
    assert not emulator.drone.flying and emulator.drone.motor_s == 0.0


def test_lands_whatever_ends_the_flight():
    with pytest.raises(RuntimeError), flying() as (emulator, _):
        raise RuntimeError
    assert emulator.drone.mode is Mode.GROUND


def test_lands_when_the_video_goes_away():
    with flying(limits=QUICK) as (emulator, tello):
        tello.start_video().wait(0, PATIENCE_S)
        listen_in(emulator, lambda text: Reply("error") if text == "streamon" else None)
        emulator.interpreter.stream = False
        until(lambda: emulator.drone.mode is Mode.GROUND)
        assert "no video" in tello.stop_reason
        with pytest.raises(TelloError):
            tello.take_off()


def test_does_not_take_off_with_an_empty_battery():
    with client(motion=True, drone=SwiftDrone(battery=0.065)) as (_, tello), pytest.raises(TelloError, match="7 %"):
        tello.take_off()


def test_bad_air_is_flown_through():
    """5 % loss and garbage on every port: safety-critical commands are repeated until acknowledged."""
    limits = TelloLimits(timeout_s=0.5, retries=20, state_loss_s=PATIENCE_S, video_loss_s=PATIENCE_S)
    with flying(limits=limits, link={"loss": 0.05, "garbage": 0.2}) as (emulator, tello):
        video = tello.start_video()
        assert video.wait(0, PATIENCE_S) is not None
        until(lambda: emulator.drone.mode is Mode.FLYING)
        assert video.wait(video.newest.count + 9, PATIENCE_S) is not None
    assert tello.stop_reason == ""
    assert emulator.drone.mode is Mode.GROUND


def test_take_off_is_repeated_until_it_is_heard_and_needs_no_answer(monkeypatch):
    """The first command is lost on the way there, every answer on the way back: the climb is seen in the state."""
    with client(TelloLimits(timeout_s=1.0, retries=3, state_loss_s=PATIENCE_S), motion=True) as (emulator, tello):
        lost = lose(emulator, "takeoff", 1)
        monkeypatch.setattr(emulator, "_answer", lambda to, text: None)
        tello.take_off()
        assert lost and emulator.drone.mode is Mode.FLYING
        tello.land()  # seen in the state, too
        assert emulator.drone.mode is Mode.GROUND and not tello.airborne


def in_a_thread(work):
    """Start ``work`` beside the test; its error of the client, if any, is the first item of the list."""
    errors = []

    def run():
        try:
            work()
        except TelloError as error:
            errors.append(str(error))

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


def test_a_landing_ends_what_another_thread_waits_for():
    with flying() as (emulator, tello):
        pilot, errors = in_a_thread(lambda: tello.move(5.0, 0.0, 0.0, 0.1))
        until(lambda: emulator.drone.busy)
    pilot.join()
    assert len(errors) == 1 and emulator.drone.mode is Mode.GROUND
    with pytest.raises(TelloError, match="landing"):
        tello.take_off()


def test_a_landing_that_fails_is_tried_again_as_long_as_the_drone_flies(monkeypatch):
    """What a guard once began it does not give up: no keep-alive, that would hold the drone in the air."""
    monkeypatch.setattr(tello_module, "_LAND_TRIES", 1)
    monkeypatch.setattr(tello_module, "_LAND_AGAIN_S", 0.1)
    with flying(limits=QUICK) as (emulator, tello):
        lost = lose(emulator, "land", 12)
        emulator.heard.clear()
        emulator.drone.battery = 0.08
        until(lambda: emulator.drone.mode is Mode.GROUND)
        assert "battery" in tello.stop_reason
    assert len(lost) == 12
    assert set(emulator.heard) <= {"land", "battery?", "streamoff"}


def test_ctrl_c_in_the_landing_is_raised_when_the_drone_is_down():
    with pytest.raises(KeyboardInterrupt), flying() as (emulator, _):
        listen_in(emulator, lambda text: _thread.interrupt_main() if text == "land" else None)
    assert emulator.drone.mode is Mode.GROUND


def test_a_drone_that_comes_down_by_itself_ends_the_flight():
    with flying(limits=QUICK) as (emulator, tello):
        until(lambda: tello.latest.fields["h"] > 50)
        emulator.drone.land()  # as by another client
        until(lambda: not tello.airborne)
        assert "by itself" in tello.stop_reason


def test_sticks_are_centred_while_the_controller_waits_for_an_answer():
    """Even if the program moves the sticks and then blocks on a command without an answer."""
    with flying(limits=TelloLimits(timeout_s=PATIENCE_S, retries=0, keep_alive_s=PATIENCE_S)) as (emulator, tello):
        lose(emulator, "sn?", 1)
        controller, errors = in_a_thread(lambda: (tello.rc(0.0, 0.0, 0.0, 1.0), tello.send("sn?")))
        until(lambda: "rc 0 0 0 0" in emulator.heard)
        assert controller.is_alive()
    controller.join()
    assert errors


def test_a_movement_takes_the_sticks_out_of_the_hand():
    """One ``rc`` that centres them, then the movement, and no more ``rc`` into it."""
    with flying() as (emulator, tello):
        tello.rc(0.0, 0.0, 0.0, 0.3)
        tello.move(2.0, 0.0, 0.0)
        begin = emulator.heard.index("rc 0 0 0 30")
        assert emulator.heard[begin : begin + 3] == ["rc 0 0 0 30", "rc 0 0 0 0", "go 200 0 0 40"]
        assert len([text for text in emulator.heard if text.startswith("rc ")]) == 2


def test_sticks_cannot_be_pushed_once_a_landing_is_wanted():
    def push():
        while True:
            tello.rc(0.0, 0.0, 0.0, 0.3)

    with flying() as (emulator, tello):
        controller, errors = in_a_thread(push)
        until(lambda: "rc 0 0 0 30" in emulator.heard)
    controller.join()
    assert "landing" in errors[0]
    assert "rc 0 0 0 30" not in emulator.heard[emulator.heard.index("land") :]


@pytest.fixture
def stranger():
    """A socket on another address than the drone's."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
        try:
            other.bind(("127.0.0.2", 0))
        except OSError:
            pytest.skip("this system has one loopback address")
        yield other


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_pictures_of_other_senders_are_refused(stranger, caplog, host):
    """A complete video stream of another sender is dropped, counted and logged once."""
    film = [packet for k in range(5) for packet in Encoder(64, 48, 30).encode(np.full((48, 64, 3), 40 * k, np.uint8))]
    sizes = set()
    with client(host=host, on_picture=lambda p: sizes.add(p.image.shape)) as (_, tello):
        video = tello.start_video()
        for packet in film:
            stranger.sendto(packet, ("127.0.0.1", tello.address.video_port))
        until(lambda: video.refused == len(film))
        assert video.wait(10, PATIENCE_S) is not None
    assert sizes == {(240, 320, 3)}
    assert tello.refused == {"video": len(film), "state": 0, "answers": 0}
    assert sum("refused" in record.message for record in caplog.records) == 1


def test_state_of_other_senders_is_refused(stranger):
    """A forged low-battery state does not land the drone."""
    with flying() as (_, tello):
        for _ in range(3):
            stranger.sendto(b"pitch:0;bat:1;h:0;tof:10;vgz:0;", ("127.0.0.1", tello.address.state_port))
        until(lambda: tello.refused["state"] == 3)
        seen = tello.latest.stamp_s
        until(lambda: tello.latest.stamp_s > seen)
        assert tello.airborne and tello.stop_reason == "" and tello.latest.fields["bat"] > 90


def test_answers_of_other_senders_are_refused(stranger):
    answers, asked = [], threading.Event()

    def late(text):
        if text == "battery?":
            asked.set()
            until(lambda: tello.refused["answers"] == 1)

    with client(TelloLimits(timeout_s=PATIENCE_S, retries=0)) as (emulator, tello):
        listen_in(emulator, late)
        question, _ = in_a_thread(lambda: answers.append(tello.query("battery?")))
        until(asked.is_set)
        stranger.sendto(b"7", ("127.0.0.1", tello._commands.port))
        question.join()
    assert answers == [100.0]


def test_listeners_that_fail_do_not_end_state_or_video(caplog):
    def fail(what):
        raise RuntimeError("disk on fire")

    with client(on_state=fail, on_picture=fail) as (_, tello):
        assert tello.start_video().wait(5, PATIENCE_S) is not None
        seen = tello.latest.stamp_s
        until(lambda: tello.latest.stamp_s > seen)
    assert sum("is not called again" in record.message for record in caplog.records) == 2


@pytest.mark.parametrize(
    ("command", "text", "belongs"),
    [("hardware?", "TELLO", True), ("sn?", "ok", False), ("go 20 0 0 30", "error Not joystick", True),
     ("takeoff", "x", False), ("land", "ok\x00", False)],
)  # fmt: skip
def test_late_answers_and_noise_are_not_taken_for_an_answer(command, text, belongs):
    assert belongs_to(command, text) is belongs


@pytest.mark.parametrize(
    ("fields", "level"),
    [
        ({"tof": 120.0, "h": 30.0}, 120.0),
        ({"tof": 6553.0, "h": 30.0}, 30.0),  # nothing in range
        ({"tof": 0.0, "h": 30.0}, 30.0),
        ({"tof": "12cm", "h": 30.0}, 30.0),
        ({"h": "x"}, None),
    ],
)
def test_the_level_is_the_range_sensors_where_it_measures_one(fields, level):
    assert Tello._level(SimpleNamespace(_fresh=lambda: fields)) == level


def test_no_answer_is_an_error_with_a_remedy():
    address = TelloAddress("127.0.0.1", *free_ports(3))
    limits = TelloLimits(timeout_s=0.1, retries=1)
    with Tello(address, limits=limits) as tello, pytest.raises(TelloError, match="is the drone on"):
        tello.connect()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:1:2:3", ("127.0.0.1", 1, 2, 3)),
        ("", ("192.168.10.1", 8889, 8890, 11111)),
        ("drone.local:9000/", ("drone.local", 9000, 8890, 11111)),
        *((wrong, None) for wrong in ("a:b", "a:0", "a:1:2:3:4", "a b", "a:70000")),
    ],
)
def test_addresses(text, expected):
    if expected is None:
        with pytest.raises(SourceError):
            TelloAddress.parse("tello://" + text)
    else:
        assert TelloAddress.parse("tello://" + text) == TelloAddress(*expected)


def test_video_survives_a_start_in_mid_stream_lost_packets_and_garbage(rng):
    encoder, assembler = Encoder(320, 240, 30), PictureAssembler()
    picture = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
    shown = []
    for k in range(95):
        for packet in encoder.encode(np.roll(picture, 3 * k, axis=1)):
            if k < 10 or rng.random() < 0.02:
                continue
            shown += assembler.feed(packet, 0.1 * k)
            if rng.random() < 0.02:
                shown += assembler.feed(rng.bytes(300), 0.1 * k)
    assert len(shown) > 20 and assembler.undecodable > 5
    assert all(p.image.shape == (240, 320, 3) for p in shown)
    assert [p.count for p in shown] == sorted({p.count for p in shown})


@pytest.mark.slow
def test_djitellopy_flies_the_emulator(monkeypatch):
    """A client that no one here wrote, its code unchanged; only the ports it uses and its patience are set."""
    if importlib.util.find_spec("djitellopy") is None:
        pytest.skip("djitellopy is not installed: pip install --no-deps djitellopy")
    import djitellopy

    with emulated() as (emulator, url):
        address = TelloAddress.parse(url)
        control = free_ports(1)[0]
        monkeypatch.setattr(djitellopy.Tello, "CONTROL_UDP_PORT", control)
        for patience in ("RESPONSE_TIMEOUT", "TAKEOFF_TIMEOUT", "FRAME_GRAB_TIMEOUT"):
            monkeypatch.setattr(djitellopy.Tello, patience, int(PATIENCE_S))
        monkeypatch.setattr(djitellopy.Tello, "STATE_UDP_PORT", address.state_port)
        monkeypatch.setattr(djitellopy.Tello, "VS_UDP_IP", "127.0.0.1")
        drone = djitellopy.Tello(host="127.0.0.1", vs_udp=address.video_port)
        drone.address = ("127.0.0.1", address.command_port)
        drone.connect()
        assert 90 < drone.get_battery() <= 100
        drone.streamon()
        reader = drone.get_frame_read()
        until(lambda: reader.frame.shape == (240, 320, 3))
        drone.takeoff()
        assert emulator.drone.mode is Mode.FLYING
        drone.move_forward(40)
        drone.rotate_counter_clockwise(90)
        assert emulator.drone.p_w[0] == pytest.approx(0.4, abs=0.1)
        until(lambda: abs(drone.get_yaw() + 90) <= 5)
        drone.send_rc_control(0, 30, 0, 0)
        until(lambda: emulator.drone.p_w[1] > 0.1)
        drone.land()
        assert emulator.drone.mode is Mode.GROUND
        assert drone.query_battery() > 90
        drone.end()
