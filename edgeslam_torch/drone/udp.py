"""UDP ports, optionally restricted to one sender."""

import logging
import socket
import threading
from collections.abc import Callable, Iterator
from typing import TypeVar

from edgeslam_torch.errors import SourceError

logger = logging.getLogger(__name__)

T = TypeVar("T")
_POLL_S = 0.2
_MAX_PACKET = 65536


class Inlet:
    """A port that accepts the packets of one host; others are ignored, counted and reported once.

    Args:
        address: Where to listen.
        purpose: For messages: "state", "video".
        host: Numeric address of the only sender that is listened to.
        buffer: Size of the receive buffer; 0 for the system's default.

    Raises:
        SourceError: If the port cannot be opened.
    """

    def __init__(self, address: tuple[str, int], purpose: str, host: str, buffer: int = 0) -> None:
        self.socket = open_udp(address, purpose)
        self.purpose, self.host = purpose, host
        self.refused = 0
        """Packets of others."""
        self._closing = threading.Event()
        self.socket.settimeout(_POLL_S)
        if buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)

    @property
    def port(self) -> int:
        """Ours."""
        return int(self.socket.getsockname()[1])

    def packets(self) -> Iterator[bytes]:
        """Packets as they come, until `stop`."""
        while not self._closing.is_set():
            try:
                packet, sender = self.socket.recvfrom(_MAX_PACKET)
            except TimeoutError:
                continue
            except OSError:  # closed, an ICMP "port unreachable", or the network is away for the moment
                self._closing.wait(0.01)
                continue
            if sender[0] == self.host:
                yield packet
                continue
            self.refused += 1
            if self.refused == 1:
                text = "%s port: packets from %s are refused; only %s is listened to"
                logger.warning(text, self.purpose, sender[0], self.host)

    def stop(self) -> None:
        """End `packets`."""
        self._closing.set()

    def close(self) -> None:
        """Give the port back."""
        self.stop()
        self.socket.close()


def open_udp(address: tuple[str, int], purpose: str) -> socket.socket:
    """A bound UDP socket.

    Raises:
        SourceError: If the address cannot be bound.
    """
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind(address)
    except OSError as error:
        udp.close()
        reason = error.strerror or str(error)
        raise SourceError(
            f"{purpose} port {address[1]} on {address[0]}: {reason}; is another client running?"
        ) from error
    return udp


def told(listener: Callable[[T], None] | None, news: T) -> Callable[[T], None] | None:
    """Tell a listener; one that fails must not interrupt a flight and is None from then on."""
    try:
        if listener is not None:
            listener(news)
        return listener
    except Exception:
        logger.exception("the listener for %s failed and is not called again", type(news).__name__)
        return None
