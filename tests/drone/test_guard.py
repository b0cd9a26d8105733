"""What the guard sends, to a socket instead of a drone; `test_ways_out.py` has it beside a whole program."""

import os
import socket
import threading

import pytest

from edgeslam_torch.drone import guard as tello_guard

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the guard inherits a socket as POSIX has it")
CENTRED, LAND = b"rc 0 0 0 0", b"land"


class Watched:
    """A guard's loop in a thread, the pipe to it, and the drone's socket."""

    def __init__(self):
        self.drone, self.commands = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for udp in (self.drone, self.commands):
            udp.bind(("127.0.0.1", 0))
        self.drone.settimeout(30.0)
        end, self.pipe = os.pipe()
        drone = self.drone.getsockname()
        self.thread = threading.Thread(target=tello_guard.watch, args=(end, self.commands, drone), daemon=True)
        self.thread.start()

    def tell(self, word):
        os.write(self.pipe, word)

    def hear(self):
        return self.drone.recv(100)

    def is_done(self):
        self.thread.join(30.0)
        return not self.thread.is_alive()

    def heard_nothing(self):
        self.drone.setblocking(False)
        with pytest.raises(BlockingIOError):
            self.drone.recv(100)
        return True


@pytest.fixture
def quick(monkeypatch):
    """The guard with time-outs of hundredths of a second."""
    monkeypatch.setattr(tello_guard, "_AGAIN_S", 0.01)
    monkeypatch.setattr(tello_guard, "_SILENCE_S", 0.01)
    monkeypatch.setattr(tello_guard, "_HANGS_S", 0.05)


def test_a_program_that_has_landed_lets_it_go_in_silence():
    guard = Watched()
    guard.tell(b"p..")
    guard.tell(b"q")
    assert guard.is_done()
    assert guard.heard_nothing()


def test_the_death_of_the_program_lands_the_drone(quick):
    guard = Watched()
    guard.tell(b"p")
    os.close(guard.pipe)
    heard = [guard.hear() for _ in range(2 * tello_guard._LAND_TRIES)]
    assert heard == [CENTRED, LAND] * tello_guard._LAND_TRIES
    assert guard.is_done()


def test_a_program_that_hangs_has_its_sticks_centred_and_then_is_landed(quick):
    guard = Watched()
    guard.tell(b"p")
    heard = [guard.hear()]
    while heard[-1] != LAND:
        heard.append(guard.hear())
    assert heard[:3] == [CENTRED] * 3
    os.close(guard.pipe)
    assert guard.is_done()


class Loud:
    """A socket that receives repeated early ``ok`` datagrams."""

    def __init__(self, sender):
        self.sender, self.sent = sender, []

    def settimeout(self, seconds):
        pass

    def sendto(self, packet, address):
        self.sent.append(packet)

    def recvfrom(self, size):
        return b"ok", (self.sender, 4000)


@pytest.mark.parametrize(("sender", "asked"), [("192.168.10.1", 4), ("192.168.10.2", 20)])
def test_only_the_drone_itself_ends_the_asking_for_a_landing(quick, sender, asked):
    """Its ok counts from the fourth request on; that of anybody else in its Wi-Fi never."""
    commands = Loud(sender)
    tello_guard.land(commands, ("192.168.10.1", 8889))
    assert commands.sent.count(LAND) == commands.sent.count(CENTRED) == asked


def test_centred_sticks_are_left_alone_while_the_program_hangs(quick):
    guard = Watched()
    guard.tell(b"p.")
    assert [guard.hear(), guard.hear()] == [CENTRED, LAND]  # the landing's own
    os.close(guard.pipe)
    assert guard.is_done()
