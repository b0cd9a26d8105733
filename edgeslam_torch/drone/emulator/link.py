"""A wireless link on loopback: delays, losses, outages."""

import heapq
import itertools
import socket
import threading
import time
from dataclasses import dataclass

import numpy as np

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults of the link."""

    loss: float = 0.0
    """Share of packets lost, each way."""
    latency_s: float = 0.003
    video_latency_s: float = 0.3
    """Latency of video; a Tello's is 0.3 to 0.8 s."""
    garbage: float = 0.0
    """Share of packets followed by one of random bytes."""

    def __post_init__(self) -> None:
        if not (0 <= self.loss < 1 and 0 <= self.garbage <= 1 and self.latency_s >= 0 and self.video_latency_s >= 0):
            raise ValueError(f"loss in [0, 1), garbage in [0, 1], latencies not negative: {self}")


class Link:
    """Sends packets later, from one thread, in the order of their due time."""

    def __init__(self, faults: LinkFaults, seed: int = 0) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(seed)
        self._heap: list[tuple[float, int, socket.socket, bytes, Address]] = []
        self._count = itertools.count()
        self._wake = threading.Condition()
        self._stopping = False
        self.cut = False
        """Complete outage while true."""
        self._thread = threading.Thread(target=self._work, name="tello-link", daemon=True)
        self._thread.start()

    def passes(self) -> bool:
        """Whether a packet is delivered."""
        return not self.cut and not (self.faults.loss > 0 and self._rng.random() < self.faults.loss)

    def send(self, sender: socket.socket, packet: bytes, to: Address, latency_s: float) -> None:
        """Queue one packet."""
        due = time.monotonic() + latency_s
        with self._wake:
            heapq.heappush(self._heap, (due, next(self._count), sender, packet, to))
            self._wake.notify()

    def stop(self) -> None:
        """End the thread; queued packets are lost."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._wake:
                while not self._stopping and (not self._heap or self._heap[0][0] > time.monotonic()):
                    self._wake.wait(self._heap[0][0] - time.monotonic() if self._heap else None)
                if self._stopping:
                    return
                _, _, sender, packet, to = heapq.heappop(self._heap)
            if not self.passes():
                continue
            _send(sender, packet, to)
            if self.faults.garbage > 0 and self._rng.random() < self.faults.garbage:
                _send(sender, self._rng.bytes(int(self._rng.integers(1, 1400))), to)


def _send(sender: socket.socket, packet: bytes, to: Address) -> None:
    try:
        sender.sendto(packet, to)
    except OSError:
        return  # no receiver, or the emulator is closing
