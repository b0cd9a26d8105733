"""A watchdog process that lands a drone whose program died, and stops one whose program hangs.

A program that is killed (out of memory, a fault in a decoder, ``kill -9``) sends nothing any more, and a real drone
then flies on for 15 s with its last stick positions. The guard shares the program's command socket, receives a
heartbeat through a pipe, and acts when it stops. It runs this file and imports nothing else of the package.
"""

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time

_ALIVE, _PUSHED, _LANDED = b".", b"p", b"q"
"""Messages of the program: sticks centred; sticks pushed; landed, the guard may exit."""
_SILENCE_S = 0.5
"""Without a heartbeat for this time the sticks are centred."""
_HANGS_S = 5.0
"""Without a heartbeat for this time the drone is landed, as without state or video."""
_AGAIN_S = 0.5
_LAND_TRIES = 20
_SURE = 3
"""Tries before an ``ok`` counts: the first may answer an earlier command."""
_CENTRED = b"rc 0 0 0 0"


class Guard:
    """The program's side of the guard.

    Args:
        commands: Command socket.
        drone: Numeric address and command port of the drone.

    Raises:
        OSError: If the process cannot be started.
    """

    def __init__(self, commands: socket.socket, drone: tuple[str, int]) -> None:
        if not sys.executable or getattr(sys, "frozen", False):
            raise OSError("no Python interpreter to run it")
        number = commands.fileno()
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, str(number), drone[0], str(drone[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[number],
            start_new_session=True,  # signals of the terminal do not reach it
            bufsize=0,
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin
        self._lock = threading.Lock()
        os.set_blocking(self._pipe.fileno(), False)

    def beat(self, pushed: bool) -> None:
        """Send a heartbeat; at least every 0.2 s."""
        self._tell(_PUSHED if pushed else _ALIVE)

    def dismiss(self, landed: bool) -> None:
        """Dismiss the guard; it still requests a landing if the drone has not landed."""
        if landed:
            self._tell(_LANDED)
        with self._lock:
            self._pipe.close()
        if landed:
            try:
                self._process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()

    def _tell(self, word: bytes) -> None:
        with self._lock:
            if self._pipe.closed:
                return
            try:
                self._pipe.write(word)
            except OSError:  # it was killed or stopped: the program continues without it
                return


def watch(pipe: int, commands: socket.socket, drone: tuple[str, int]) -> None:
    """Watch until the program reports a landing, dies, or hangs."""
    pushed, silent_s = False, 0.0
    while silent_s < _HANGS_S:
        if not select.select([pipe], [], [], _SILENCE_S)[0]:
            silent_s += _SILENCE_S
            if pushed:
                _send(commands, _CENTRED, drone)
            continue
        silent_s, received = 0.0, os.read(pipe, 4096)
        if not received:
            break
        if received.endswith(_LANDED):
            return
        pushed = received.endswith(_PUSHED)
    land(commands, drone)


def land(commands: socket.socket, drone: tuple[str, int]) -> None:
    """Request a landing until it is answered or the tries are used up."""
    commands.settimeout(_AGAIN_S)
    for attempt in range(_LAND_TRIES):
        _send(commands, _CENTRED, drone)
        _send(commands, b"land", drone)
        again_s = time.monotonic() + _AGAIN_S
        while time.monotonic() < again_s:
            if _agreed(commands, drone) and attempt >= _SURE:
                return


def _agreed(commands: socket.socket, drone: tuple[str, int]) -> bool:
    try:
        packet, sender = commands.recvfrom(2048)
    except TimeoutError:
        return False
    except OSError:
        time.sleep(_AGAIN_S)
        return False
    return sender[0] == drone[0] and packet.lower().startswith(b"ok")


def _send(commands: socket.socket, packet: bytes, drone: tuple[str, int]) -> None:
    try:
        commands.sendto(packet, drone)
    except OSError:
        return  # no network at the moment; will be repeated


def main() -> None:
    """The guard's process: number of the inherited socket, host and port of the drone."""
    number, host, port = sys.argv[1:]
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    watch(sys.stdin.fileno(), socket.socket(fileno=int(number)), (host, int(port)))


if __name__ == "__main__":
    main()
