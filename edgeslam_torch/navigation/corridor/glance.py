"""A look to the sides of a corridor that seems to end: what turns off before a dead end is hardly seen in passing."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.corridor.onward import unknown_sides
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.sight import Sight
from edgeslam_torch.types import FloatArray

_BACK_M = 2.2
"""Way back from the end to where it looks: the middle of what a turn at the end shows aslant."""
_THERE_M = 0.3
_THERE_RAD = math.radians(5.0)
_STANDS_S = 1.0
"""Time of a look: five views."""
_TURN_S = 12.5
"""Time of a turn on the spot, 30 degrees a second: what turns off right there is seen by that."""
_GIVEN_UP_S = 20.0


@dataclass(slots=True)
class Glance:
    """Back from the end, to each side that is not known to be a wall, and to the end again."""

    end_w: FloatArray
    """``(2,)`` where the corridor seems to end."""
    axis: FloatArray
    """``(2,)`` unit vector of its direction there."""
    _headings: list[float] | None = None
    """Still to be looked at, last first; None before it was there."""
    _reached_s: float = math.nan
    """Since when it looks at the last of these."""
    _began_s: float = math.nan
    over: bool = False
    """Whether it has looked, and is back at the end."""

    def goal(self, layer: Layer, sight: Sight) -> FloatArray | None:
        """Where to fly ``(2,)``; None when nothing is left to do, and at first, for a turn on the spot."""
        self._began_s = sight.stamp_s if math.isnan(self._began_s) else self._began_s
        if (since_s := sight.stamp_s - self._began_s) < _TURN_S:
            return None
        place = self.end_w - _BACK_M * self.axis
        if self._headings is None:
            sides = unknown_sides(layer, self.end_w, self.axis)
            if not sides or since_s > _TURN_S + _GIVEN_UP_S:
                self._headings = []
            elif np.linalg.norm(sight.p_w[:2] - place) < _THERE_M:
                self._headings = [math.atan2(side[1], side[0]) for side in sides]
            else:
                return place
        self.over = float(np.linalg.norm(sight.p_w[:2] - self.end_w)) < _THERE_M
        return None if self.over else self.end_w

    def heading_rad(self, sight: Sight) -> float | None:
        """Where to look now, standing; a pose that is lost ends it."""
        if not self._headings:
            return None
        if not sight.tracked:
            self._headings = []
            return None
        if abs(float(wrapped(np.array(self._headings[-1] - sight.yaw_rad)))) > _THERE_RAD:
            self._reached_s = sight.stamp_s
        elif sight.stamp_s - self._reached_s > _STANDS_S:
            self._headings.pop()
            self._reached_s = sight.stamp_s
        return self._headings[-1] if self._headings else None

    def carry(self, moved: Moved) -> None:
        """Take the end along with the map."""
        self.end_w = moved.points(self.end_w[None])[0]
