"""Addresses of a Tello's three channels, remote and local."""

import re
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from edgeslam_torch.drone.answers import TelloError
from edgeslam_torch.errors import SourceError

TELLO_HOST = "192.168.10.1"


@dataclass(frozen=True, slots=True)
class TelloAddress:
    """Addresses of a drone's three channels, remote and local."""

    host: str = TELLO_HOST
    command_port: int = 8889
    state_port: int = 8890
    video_port: int = 11111
    bind: str | None = None
    """Local address; ``None`` selects the interface that routes to the drone."""

    @classmethod
    def parse(cls, text: str) -> "TelloAddress":
        """From ``tello://HOST[:COMMAND[:STATE[:VIDEO]]]`` or ``HOST``; no host means 192.168.10.1.

        Raises:
            SourceError: If it is not such an address.

        Example:
            >>> TelloAddress.parse("tello://127.0.0.1:9000:9001:9002").video_port
            9002
        """
        body = text.removeprefix("tello://").rstrip("/")
        host, *ports = body.split(":") if body else [TELLO_HOST]
        if (
            len(ports) > 3
            or not re.fullmatch(r"[A-Za-z0-9._-]*", host)
            or urlsplit(f"//{host}").hostname != (host.lower() or None)
        ):
            raise SourceError(f"{text}: not a drone's address; give tello://HOST[:COMMAND[:STATE[:VIDEO]]]")
        numbers = []
        for port in ports:
            if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
                raise SourceError(f"{text}: port {port!r} is not a number from 1 to 65535")
            numbers.append(int(port))
        defaults = [8889, 8890, 11111]
        command, state, video = numbers + defaults[len(numbers) :]
        return cls(host or TELLO_HOST, command, state, video)

    def ends(self) -> tuple[str, str]:
        """Numeric addresses of the drone and of the local interface.

        Raises:
            TelloError: If the drone's name cannot be resolved or there is no route to it.
        """
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.connect((self.host, self.command_port))  # sends nothing
                return str(probe.getpeername()[0]), self.bind or str(probe.getsockname()[0])
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise TelloError(
                f"{self.host}: unreachable ({reason}); join the drone's Wi-Fi (TELLO-XXXXXX) first"
            ) from error
