"""What a navigator flies: a drone over UDP (`udp_vehicle.py`) or one in lockstep (`lockstep_vehicle.py`)."""

from collections.abc import Callable
from typing import Protocol

from edgeslam_torch.geometry.camera import Camera


class Vehicle(Protocol):
    """A drone with perception and a flight_controller; verbs of a navigator are all about these."""

    camera: Camera
    over: str
    """Why the flight is over; empty before and during it."""

    @property
    def flying(self) -> bool:
        """Whether it has taken off and does not land yet."""

    @property
    def battery(self) -> float:
        """Charge in [0, 1]; NaN if it was never told."""

    def take_off(self) -> None:
        """Rise to where the drone itself hovers; the flight_controller gives the orders from then on.

        Raises:
            TelloError: If the drone does not.
        """

    def fly(self, until: Callable[[], bool]) -> None:
        """Let time pass until something holds or the flight is over."""

    def land(self, why: str) -> None:
        """Land and wait until it stands."""

    def stop(self, why: str) -> None:
        """Ask for a landing, if it flies, and return at once; callable from a signal handler."""

    def close(self) -> None:
        """Land if it flies, and leave."""
