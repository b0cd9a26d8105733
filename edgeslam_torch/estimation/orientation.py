"""Orientation of the map, and of the camera on the drone, from the drone's attitude."""

import math

import numpy as np

from edgeslam_torch.estimation.scale.camera_mount import Turned, mount_by_turns
from edgeslam_torch.estimation.telemetry.alignment import LATELY, attitudes
from edgeslam_torch.estimation.telemetry.comparison import MAX_DEVIATION_RAD
from edgeslam_torch.estimation.telemetry.remembered import Remembered
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.noise import DELAY_S, MOUNT_RAD
from edgeslam_torch.types import FloatArray

_AT_ONCE_S = 0.5
"""Time after the first frame in which the first attitude must arrive to level the map: five messages."""


class Orientation:
    """Rotations of one flight's map.

    Args:
        flight: Messages and poses so far.
        given: Configured pose of the camera in the body ``(4, 4)`` [m].
    """

    def __init__(self, flight: Remembered, given: FloatArray) -> None:
        self._flight, self.given = flight, given
        self.found: Turned | None = None
        """Result of the newest fit; None without telemetry attitude."""
        self.began_s = math.nan
        """Stamp of the first frame."""
        self.began_upright = False
        """Whether the map's z axis is up: its first pose was set by the drone's attitude."""
        self._attitude_s = math.inf

    @property
    def R_w_m(self) -> FloatArray | None:
        """``(3, 3)`` map axes to the drone's power-on world; None without telemetry attitude."""
        return None if self.found is None else self.found.R_w_m

    @property
    def T_b_c(self) -> FloatArray:
        """Camera in the body ``(4, 4)`` [m] as estimated, consistent with `R_w_m`."""
        if self.found is None:
            return self.given
        T_b_c = self.given.copy()
        T_b_c[:3, :3] = self.found.R_b_c
        return T_b_c

    @property
    def mount_turned_rad(self) -> float:
        """Angle between the estimated and the configured mount."""
        return float(np.linalg.norm(rotation_vector(self.T_b_c[:3, :3] @ self.given[:3, :3].T)))

    def note_attitude(self, stamp_s: float) -> None:
        """Record a message with attitude."""
        self._attitude_s = min(self._attitude_s, stamp_s)

    def fitted(self) -> Turned | None:
        """Fit to all stored poses; the mount is estimated only after the attitude was validated by images."""
        flight = self._flight
        pairs = attitudes(flight.memory.newest(), flight.track, flight.delay_s)
        if pairs is None:
            return None
        R_b_c, sigma_rad = self.given[:3, :3], MOUNT_RAD
        if flight.trust.turns:
            return mount_by_turns(pairs.R_m_c, pairs.R_w_b, pairs.stamp_s, R_b_c, sigma_rad)
        return Turned(R_b_c, pairs.map_to_world(R_b_c), np.full(3, sigma_rad))

    def has_diverged(self) -> bool:
        """Whether a validated attitude has begun to disagree with the images."""
        flight, found = self._flight, self.found
        usable = found is not None and flight.trust.turns and math.isfinite(flight.delay_sigma_s)
        pairs = attitudes(flight.memory.newest(LATELY), flight.track, flight.delay_s) if usable else None
        if pairs is None or found is None:
            return False
        return (
            float(np.linalg.norm(rotation_vector(pairs.map_to_world(found.R_b_c) @ found.R_w_m.T))) > MAX_DEVIATION_RAD
        )

    def upright(self) -> FloatArray | None:
        """``R_w_m`` if attitude may level the world: when it was validated, or arrived with the first frame."""
        if self.found is None or not self._flight.trust.attitude:
            return None
        at_once = self._attitude_s - self.began_s < _AT_ONCE_S
        return self.found.R_w_m if at_once or self._flight.trust.turns else None

    @property
    def up(self) -> tuple[FloatArray, float] | None:
        """The vertical ``(3,)`` in the map by an attitude that may level the world, and its standard deviation [rad]:
        of the mount, and of attitudes of other moments than the poses, as the delay is uncertain."""
        if self.found is None or self.upright() is None:
            return None
        flight = self._flight
        at_s = flight.memory.sightings().stamps_s - flight.delay_s
        leaned = float(np.median(flight.track.leaned(at_s, min(flight.delay_sigma_s, DELAY_S))))
        return self.found.R_w_m[2], math.hypot(float(self.found.sigma_rad[:2].max()), leaned)

    def leaning(self) -> str | None:
        """Warning that no usable attitude levelled the world; None if the drone sent none."""
        if not math.isfinite(self._attitude_s):
            return None
        return (
            "the direction of gravity is unknown, the world leans as the first camera did: no attitude of the drone "
            "that arrived at once or was validated covers a frame with a pose (the first one came "
            f"{self._attitude_s - self.began_s:.1f} s after the first frame)"
        )
