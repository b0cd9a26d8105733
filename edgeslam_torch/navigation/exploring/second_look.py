"""Second look at a candidate opening from another viewpoint in front of it.

From a single viewpoint an opening is indistinguishable from a gap between two objects or a depth error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import reachable
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import PLACES_M, Candidate
from edgeslam_torch.types import FloatArray

_BEFORE_M = (0.8, 2.0)
"""Distances in front of the wall at which an opening fits into the field of view and depth is reliable."""
_ASIDE = 0.3
"""Lateral offset of the viewpoint over that distance: 17 degrees. From farther aside the far jamb hides the space
behind."""
_ELSEWHERE_M = PLACES_M + 0.1
"""Minimum distance from the first viewpoint, with a margin for pose errors."""
_INSIDE_M = 0.15
"""Margin of goals inside the viewing region: the planner stops slightly short of a goal."""
_PASSED_M = 0.3
"""Distance of viewpoints from obstacles."""
_STANDS_S = 4.0
"""Duration of a look: a right-angle turn and five detections."""
_SOUGHT_S = 30.0
"""Timeout of the flight to a viewpoint: six metres and one look around."""
_ON_THE_WAY_M = 1.2
"""Distance of a viewpoint that is no detour."""
_SAME_M = 0.5
"""Distance within which candidates are the same; the estimate moves as it is observed."""
_TIMES = 3
"""Maximum number of looks at one candidate, if nothing else is left to do ..."""
_APART_M = 0.3
"""... and minimum distance between their viewpoints."""


@dataclass(slots=True)
class _Tried:
    """Looks at a candidate."""

    centre: Places
    until_s: float = np.inf
    """Time at which it is given up."""
    stood: Places = field(default_factory=Places)
    """Viewpoint of each look."""
    times: int = 1

    @property
    def stands(self) -> bool:
        """Whether the drone has reached the current viewpoint."""
        return len(self.stood) == self.times

    def is_new(self, p_w: np.ndarray) -> np.ndarray:
        """``(P,)`` whether points ``(P, 2)`` differ from the viewpoints of earlier looks."""
        before = self.stood.p_w[: self.times - 1]
        return np.asarray((np.linalg.norm(p_w[:, None] - before, axis=-1) > _APART_M).all(axis=1))


@dataclass(slots=True)
class SecondLook:
    """Viewpoints and headings of second looks."""

    _candidates: Sequence[Candidate] = ()
    _tried: list[_Tried] = field(default_factory=list)

    def consider(self, candidates: Sequence[Candidate]) -> None:
        """Set the current candidates."""
        self._candidates = candidates

    def on_the_way(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells of `goals` near the drone."""
        return self._from(self._standing(layer, state, _ON_THE_WAY_M), layer, state)

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Reachable viewpoint cells ``(G, 2)``."""
        return self._from(self._standing(layer, state, np.inf), layer, state)

    def _standing(self, layer: Layer, state: DroneState, reach_m: float) -> np.ndarray:
        """Reachable cells ``(C, 2)`` with clearance, within ``reach_m``."""
        cells = np.argwhere(layer.free & (layer.from_solid_m > _PASSED_M))
        near = np.linalg.norm(layer.centres(cells).reshape(-1, 2) - state.p_w[:2], axis=1) <= reach_m
        return reachable(cells[near], layer, state.p_w[:2])

    def _from(self, cells: np.ndarray, layer: Layer, state: DroneState) -> np.ndarray:
        found = [np.zeros((0, 2), int)]
        for candidate, tried in self._worth(state):
            p_w = layer.centres(cells).reshape(-1, 2)
            there = cells[_shows(candidate, p_w, _INSIDE_M) & tried.is_new(p_w)]
            if len(there):
                tried.until_s = min(tried.until_s, state.stamp_s + _SOUGHT_S)
            found.append(there)
        return np.concatenate(found)

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to a candidate visible from here; None otherwise."""
        for candidate, tried in self._worth(state):
            if _shows(candidate, state.p_w[None, :2])[0] and tried.is_new(state.p_w[None, :2])[0]:
                if not tried.stands:
                    tried.stood.add(state.views, state.p_w[:2])
                    tried.until_s = state.stamp_s + _STANDS_S
                step = candidate.centre_w - state.p_w[:2]
                return float(np.arctan2(step[1], step[0]))
        return None

    def once_more(self, state: DroneState) -> None:
        """Allow another look at candidates that were given up."""
        for tried in (self._of(candidate, state) for candidate in self._candidates):
            if state.stamp_s >= tried.until_s and tried.stands and tried.times < _TIMES:
                tried.times, tried.until_s = tried.times + 1, np.inf

    def _worth(self, state: DroneState) -> list[tuple[Candidate, _Tried]]:
        """Candidates that were not given up."""
        both = [(candidate, self._of(candidate, state)) for candidate in self._candidates]
        return [(candidate, tried) for candidate, tried in both if state.stamp_s < tried.until_s]

    def _of(self, candidate: Candidate, state: DroneState) -> _Tried:
        for tried in self._tried:
            if tried.centre.is_near(candidate.centre_w, _SAME_M):
                return tried
        self._tried.append(_Tried(Places(state.views, candidate.centre_w)))
        return self._tried[-1]


def _shows(candidate: Candidate, p_w: FloatArray, inside_m: float = 0.0) -> np.ndarray:
    """``(P,)`` whether a candidate is visible from points ``(P, 2)``: in front of it, on the side of its first
    viewpoint but away from that, and at least ``inside_m`` inside this region."""
    away = (candidate.place_w - candidate.centre_w) @ candidate.normal_w
    before = (p_w - candidate.centre_w) @ candidate.normal_w * (1.0 if away >= 0 else -1.0)
    aside = np.abs((p_w - candidate.centre_w) @ np.array([-candidate.normal_w[1], candidate.normal_w[0]]))
    elsewhere = np.linalg.norm(p_w - candidate.place_w, axis=1) >= _ELSEWHERE_M + inside_m
    elsewhere |= not candidate.elsewhere
    apart = (before >= _BEFORE_M[0] + inside_m) & (before <= _BEFORE_M[1] - inside_m)
    return np.asarray(apart & (aside <= _ASIDE * before - inside_m) & elsewhere)
