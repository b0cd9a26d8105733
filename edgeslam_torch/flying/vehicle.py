"""Vehicle interface: a drone over UDP (`udp_vehicle.py`) or an emulated one in lockstep (`lockstep_vehicle.py`)."""

from collections.abc import Callable
from typing import Protocol

from edgeslam_torch.geometry.camera import Camera

TICK_S = 0.05
"""Control cycle."""


class Vehicle(Protocol):
    """A drone with perception and flight controller."""

    camera: Camera
    over: str
    """Why the flight ended; empty before and during it."""

    @property
    def flying(self) -> bool:
        """Whether it has taken off and is not landing yet."""

    @property
    def battery(self) -> float:
        """Charge in [0, 1]; NaN if unknown."""

    def take_off(self) -> None:
        """Take off; the flight controller gives the orders from then on.

        Raises:
            TelloError: If the drone does not take off.
        """

    def fly(self, until: Callable[[], bool]) -> None:
        """Run until a condition holds or the drone has landed, as the flight controller orders."""

    def close(self) -> None:
        """Land if flying, and disconnect."""
