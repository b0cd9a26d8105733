"""When a map that tells no sure metres is given up for a new one, and where that begins.

A map that was begun on the floor may be wrong from its first second: planks of a floor look alike, the map sinks while
the drone climbs, and all that is added to it agrees. A new one, begun in the air, stands after as many seconds.
"""

import math

import numpy as np

from edgeslam_torch.flying.perception.home import GROUND_M, TAKE_OFF, Place
from edgeslam_torch.types import TelemetrySample

PATIENCE_S = 8.0
"""Time in the air without sure metres: a map that tells them does so within six seconds of a drone that goes up and
down."""
IN_AIR_M = 0.3
"""Told height above the floor from which on a drone is in the air, in three of the SDK's steps."""
NEAR_M = 1.0
"""Way from the take-off, by the drone's own velocities, after which a map is kept whatever it tells: it knows the way
back, and velocities in steps of a decimetre a second do not."""


class MapReset:
    """Dead reckoning from the take-off, and the time without metres."""

    def __init__(self) -> None:
        self._began: TelemetrySample | None = None
        """The first message."""
        self._last: TelemetrySample | None = None
        self._moved_m = np.zeros(3)
        """Way since the first one in the axes of power-on."""
        self._has_left = False
        self._since_s = math.nan
        """Since when it has been in the air without sure metres."""

    def heard(self, sample: TelemetrySample) -> None:
        """Take a state message; one without velocity, attitude and height tells nothing."""
        if not np.isfinite([*sample.velocity_m_s, *sample.rpy_rad, sample.height_m]).all():
            return
        if self._last is not None:
            pause_s = sample.stamp_s - self._last.stamp_s
            self._moved_m += 0.5 * pause_s * (self._last.velocity_m_s + sample.velocity_m_s)
            self._has_left = self._has_left or bool(np.linalg.norm(self._moved_m[:2]) > NEAR_M)
        self._began = self._began or sample
        self._last = sample

    def is_due(self, stamp_s: float, sure: bool) -> bool:
        """Whether it is time for a new map; asked at each picture.

        Args:
            stamp_s: Of the picture.
            sure: Whether the map tells metres that one can fly by.
        """
        flies = self._last is not None and self._last.height_m >= IN_AIR_M
        if sure or not flies or self._has_left:
            self._since_s = math.nan
            return False
        if math.isnan(self._since_s):
            self._since_s = stamp_s
        return stamp_s - self._since_s >= PATIENCE_S

    def begin(self) -> Place:
        """Where a map that begins now begins, in the drone's own world; the next one must wait as long."""
        self._since_s = math.nan
        if self._began is None or self._last is None:
            return TAKE_OFF
        yaw = float(self._began.rpy_rad[2])
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = np.array([[c, s], [-s, c]]) @ self._moved_m[:2]
        return Place(np.array([x, y, self._last.height_m + GROUND_M]), float(self._last.rpy_rad[2]) - yaw)
