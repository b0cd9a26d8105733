"""Reset of a map whose scale stays uncertain, and the start pose of the new one.

A map initialised on the floor may be wrong from the start: repetitive floor texture causes false matches during the
climb, and the map stays consistent with them. A new map initialised in the air converges within seconds.
"""

import math

import numpy as np

from edgeslam_torch.flying.perception.home import GROUND_M, TAKE_OFF, Place
from edgeslam_torch.types import TelemetrySample

PATIENCE_S = 8.0
"""Time in the air without a certain scale; vertical oscillation makes the scale of a sound map certain within 6 s."""
IN_AIR_M = 0.3
"""Reported height from which the drone is in the air: three steps of the SDK's resolution."""
NEAR_M = 1.0
"""Distance from the take-off by integrated velocities beyond which the map is kept: dead reckoning with velocities
quantised to 0.1 m/s no longer leads back."""


class MapReset:
    """Dead reckoning from the take-off, and the time without a certain scale."""

    def __init__(self) -> None:
        self._began: TelemetrySample | None = None
        """The first message."""
        self._last: TelemetrySample | None = None
        self._moved_m = np.zeros(3)
        """Displacement since the first message in power-on axes."""
        self._has_left = False
        self._since_s = math.nan
        """Since when it has been in the air without a certain scale."""

    def add_telemetry(self, sample: TelemetrySample) -> None:
        """Process a state message; one without velocity, attitude and height is ignored."""
        if not np.isfinite([*sample.velocity_m_s, *sample.rpy_rad, sample.height_m]).all():
            return
        if self._last is not None:
            pause_s = sample.stamp_s - self._last.stamp_s
            self._moved_m += 0.5 * pause_s * (self._last.velocity_m_s + sample.velocity_m_s)
            self._has_left = self._has_left or bool(np.linalg.norm(self._moved_m[:2]) > NEAR_M)
        self._began = self._began or sample
        self._last = sample

    def is_due(self, stamp_s: float, sure: bool) -> bool:
        """Whether to start a new map; call it for every frame.

        Args:
            stamp_s: Time of the frame.
            sure: Whether the map's scale is certain.
        """
        flies = self._last is not None and self._last.height_m >= IN_AIR_M
        if sure or not flies or self._has_left:
            self._since_s = math.nan
            return False
        if math.isnan(self._since_s):
            self._since_s = stamp_s
        return stamp_s - self._since_s >= PATIENCE_S

    def begin(self) -> Place:
        """Start pose of a map that begins now, in the drone's world; restarts the timer."""
        self._since_s = math.nan
        if self._began is None or self._last is None:
            return TAKE_OFF
        yaw = float(self._began.rpy_rad[2])
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = np.array([[c, s], [-s, c]]) @ self._moved_m[:2]
        return Place(np.array([x, y, self._last.height_m + GROUND_M]), float(self._last.rpy_rad[2]) - yaw)
