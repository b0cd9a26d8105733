"""Where a drone that explores looks around, and where it has done so."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.sight import Sight
from edgeslam_torch.types import FloatArray

_EVERY_M = 1.2
"""Way from one look around to the next: a door of 0.85 m is seen from two places."""
_BETWEEN_M = 0.5
"""Distance from all places where half way between two of them is another one, on another pass: what was seen aslant
from both is seen squarely from there."""
_HALF_WAY_M = 0.25
"""Distance from half way that counts as there."""
_SIDE_RAD = math.radians(75.0)
"""Turn to each side: half of a camera's 55 degrees more are seen, so all but what is behind."""
_THERE_RAD = math.radians(8.0)
_GIVEN_UP_S = 12.0
"""Time of a look: five quarter turns at 60 degrees a second, twice."""


@dataclass(slots=True)
class LooksAround:
    """Asks for headings, one after the other, at places that are a way apart."""

    _places_w: list[FloatArray] = field(default_factory=list)
    """``(2,)`` where it looked around."""
    _headings: list[float] = field(default_factory=list)
    """Still to be looked at, last first."""
    _since_s: float = math.nan

    def between(self, layer: Layer) -> np.ndarray:
        """Free cells ``(G, 2)`` half way from one place to the next, where it has not looked around."""
        cells = layer.cells(self._half_way())
        return np.asarray(cells[layer.free[cells[:, 0], cells[:, 1]]])

    def _half_way(self) -> FloatArray:
        """Those places ``(H, 2)``."""
        places = np.array(self._places_w).reshape(-1, 2)
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        middle = (0.5 * (places[1:] + places[:-1]))[steps < 2.0 * _EVERY_M]
        return middle[np.array([self._away_m(p_w) > _BETWEEN_M for p_w in middle], dtype=bool)]

    def _away_m(self, here_w: FloatArray) -> float:
        return min((float(np.linalg.norm(here_w - place)) for place in self._places_w), default=math.inf)

    def _is_new(self, here_w: FloatArray, closely: bool) -> bool:
        if self._away_m(here_w) > _EVERY_M:
            return True
        return closely and bool((np.linalg.norm(self._half_way() - here_w, axis=1) < _HALF_WAY_M).any())

    def heading_rad(self, sight: Sight, closely: bool = False) -> float | None:
        """Where to look now; None to look ahead. A pose that is lost in a turn ends the look.

        Args:
            sight: Of this moment.
            closely: Whether half way between two places counts as another one, on another pass.
        """
        here = sight.p_w[:2]
        if not self._headings and self._is_new(here, closely):
            self._places_w.append(here.copy())
            self._headings = [sight.yaw_rad + side * _SIDE_RAD for side in (0.0, 1.0, -1.0)]
            self._since_s = sight.stamp_s
        if not sight.tracked or sight.stamp_s - self._since_s > _GIVEN_UP_S:
            self._headings = []
        while self._headings and abs(float(wrapped(np.array(self._headings[-1] - sight.yaw_rad)))) < _THERE_RAD:
            self._headings.pop()
        return self._headings[-1] if self._headings else None

    def carry(self, moved: Moved) -> None:
        """Take the places along with the map; directions of level flight hardly turn with it."""
        self._places_w = list(moved.points(np.array(self._places_w).reshape(-1, 2)))
