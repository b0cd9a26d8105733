"""Free ports for tests that talk over loopback."""

import random
import socket


def free_ports(count):
    """Free ports below the ephemeral range, which begins at 32768."""
    sockets = []
    try:
        while len(sockets) < count:
            udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sockets.append(udp)
            try:
                udp.bind(("127.0.0.1", random.SystemRandom().randrange(12000, 32000)))
            except OSError:
                sockets.pop().close()
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()
