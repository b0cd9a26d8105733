"""Frontiers between free and unknown space, and a record of those inspected without success."""

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.types import FloatArray

PASSED_M = NavLimits().clearance_m(0.0)
"""Distance from obstacles at which the drone passes; what is closer to one is unreachable."""
_FRONTIER_M = 0.3
"""Minimum frontier length; shorter ones are gaps between rays. A doorway of 0.85 m leaves this much."""
WIDE_M = 1.0
"""Length from which a frontier belongs to a room or corridor; shorter ones are doorways and gaps behind furniture."""
_NEAR_M = 1.2
"""Distance within which a view should resolve a frontier."""
_LOOKED_S = 4.0
"""Time near a frontier after which it counts as unresolvable: it lies outside the vertical field of view."""
_SAME_M = 0.6
"""Distance within which frontiers are the same; they move as they are observed."""
_ROUND_S = 13.0
"""Duration of a full turn plus a second, after which nothing is left to explore."""


def frontiers(layer: Layer, least_m: float = _FRONTIER_M) -> np.ndarray:
    """One cell ``(F, 2)`` for each frontier of at least ``least_m``."""
    unseen = ~layer.free & ~layer.solid
    border = layer.free & ndimage.binary_dilation(unseen) & (layer.from_solid_m > PASSED_M)
    parts, count = ndimage.label(border, np.ones((3, 3)))
    out = []
    for part in range(1, count + 1):
        cells = np.argwhere(parts == part)
        if len(cells) * layer.cell_m >= least_m:
            out.append(cells[int(np.argmin(((cells - cells.mean(0)) ** 2).sum(1)))])
    return np.array(out, dtype=int).reshape(-1, 2)


def reachable(cells: np.ndarray, layer: Layer, here_w: FloatArray) -> np.ndarray:
    """Cells ``(G, 2)`` connected to a point ``(2,)`` through space without obstacles."""
    passable = layer.part_around(layer.from_solid_m > PASSED_M - 0.5 * layer.cell_m, here_w)
    return np.asarray(cells[passable[tuple(cells.T)]])


@dataclass(slots=True)
class Looks:
    """Record of frontiers inspected without success, and since when none is left."""

    _near: Places = field(default_factory=Places)
    """Frontiers that the drone was near to."""
    _spent_s: list[float] = field(default_factory=list)
    """Time spent near each [s]."""
    _last_call_s: float = math.nan
    _nothing_s: float = math.nan

    def worth(self, cells: np.ndarray, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells ``(G, 2)`` not yet inspected without success; call it at every plan."""
        passed = 0.0 if math.isnan(self._last_call_s) else min(state.stamp_s - self._last_call_s, 1.0)
        self._last_call_s = state.stamp_s
        places = layer.centres(cells).reshape(-1, 2)
        for place in places[np.linalg.norm(places - state.p_w[:2], axis=1) < _NEAR_M]:
            self._spend(place, passed, state)
        kept = cells[self.left(places)]
        if len(kept):
            self._nothing_s = math.nan
        elif math.isnan(self._nothing_s):
            self._nothing_s = state.stamp_s
        return np.asarray(kept)

    def left(self, p_w: FloatArray) -> np.ndarray:
        """Which of the points ``(N, 2)`` were not inspected without success."""
        vain = self._near.p_w[np.array(self._spent_s) > _LOOKED_S]
        return np.asarray((np.linalg.norm(p_w[:, None] - vain, axis=2) > _SAME_M).all(axis=1))

    def go_on(self) -> None:
        """Reset the end timer: other goals exist."""
        self._nothing_s = math.nan

    def over(self, now_s: float) -> bool:
        """Whether no frontier was left for `_ROUND_S`."""
        return now_s - self._nothing_s > _ROUND_S  # false while it is NaN

    def _spend(self, place_w: FloatArray, passed_s: float, state: DroneState) -> None:
        same = np.flatnonzero(np.linalg.norm(self._near.p_w - place_w, axis=1) <= _SAME_M)
        if len(same):
            self._spent_s[same[0]] += passed_s
        else:
            self._near.add(state.views, place_w)
            self._spent_s.append(passed_s)
