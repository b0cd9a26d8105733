"""A second look at what looked like an opening: from a place before it where it was not seen from yet.

A way that is closed beside a door, or a search that ends before it, leaves an opening seen from one place, which is
none yet: from there a gap between two things, or a wrong depth, looks the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.frontiers import reachable
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import PLACES_M, Candidate
from edgeslam_torch.types import FloatArray

_BEFORE_M = (0.8, 2.0)
"""Distance before the wall from which its opening fills no more than a camera's picture, and is not beyond trust."""
_ASIDE = 0.3
"""How far aside of the opening, in shares of that distance: 17 degrees. From farther aside its far jamb is what is
seen through it, and free space opens by a slit."""
_ELSEWHERE_M = PLACES_M + 0.1
"""Distance from where it was seen: a pose is not known to the centimetre."""
_INSIDE_M = 0.15
"""How far inside of where an opening shows a drone is sent: at its border it would stand, as near as pilots come to
a goal."""
_PASSED_M = 0.3
"""Distance from solids of where it stands to look."""
_STANDS_S = 4.0
"""Time of a look: a turn by a right angle, and five of those that count."""
_SOUGHT_S = 30.0
"""Time after which the way there is given up: six metres, and a look around on it."""
_ON_THE_WAY_M = 1.2
"""Distance of a place to look from that is no detour: as far as from one look around to the next."""
_SAME_M = 0.5
"""An opening moves as it is looked at."""
_TIMES = 3
"""Looks at one opening in all, if nothing else is left to do: what half of it showed has another middle ..."""
_APART_M = 0.3
"""... and is looked at from another place."""


@dataclass(slots=True)
class _Tried:
    """What was done about a candidate."""

    centre_w: FloatArray
    until_s: float = np.inf
    """When it is given up."""
    stood_w: list[FloatArray] = field(default_factory=list)
    """``(2,)`` from where it was looked at, look by look."""
    times: int = 1

    @property
    def stands(self) -> bool:
        """Whether the drone has come to where it shows this time."""
        return len(self.stood_w) == self.times

    def is_new(self, p_w: np.ndarray) -> np.ndarray:
        """``(P,)`` whether places ``(P, 2)`` are others than those of earlier looks."""
        before = np.array(self.stood_w[: self.times - 1]).reshape(-1, 2)
        return np.asarray((np.linalg.norm(p_w[:, None] - before, axis=-1) > _APART_M).all(axis=1))


@dataclass(slots=True)
class SecondLook:
    """Where to go and look, for as long as that may tell more."""

    _candidates: Sequence[Candidate] = ()
    _tried: list[_Tried] = field(default_factory=list)

    def consider(self, candidates: Sequence[Candidate]) -> None:
        """What is worth a second look now."""
        self._candidates = candidates

    def on_the_way(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Those of the cells of `goals` that are near."""
        return self._from(self._standing(layer, state, _ON_THE_WAY_M), layer, state)

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells ``(G, 2)`` that can be reached, from which to look at one of them."""
        return self._from(self._standing(layer, state, np.inf), layer, state)

    def _standing(self, layer: Layer, state: DroneState, reach_m: float) -> np.ndarray:
        """Cells ``(C, 2)`` where a drone can stand, no farther than this."""
        cells = np.argwhere(layer.free & (layer.from_solid_m > _PASSED_M))
        near = np.linalg.norm(layer.centres(cells).reshape(-1, 2) - state.p_w[:2], axis=1) <= reach_m
        return reachable(cells[near], layer, state.p_w[:2])

    def _from(self, cells: np.ndarray, layer: Layer, state: DroneState) -> np.ndarray:
        found = [np.zeros((0, 2), int)]
        for candidate, tried in self._worth(state.stamp_s):
            p_w = layer.centres(cells).reshape(-1, 2)
            there = cells[_shows(candidate, p_w, _INSIDE_M) & tried.is_new(p_w)]
            if len(there):
                tried.until_s = min(tried.until_s, state.stamp_s + _SOUGHT_S)
            found.append(there)
        return np.concatenate(found)

    def heading_rad(self, state: DroneState) -> float | None:
        """Where to look, standing where one of them shows; None elsewhere."""
        for candidate, tried in self._worth(state.stamp_s):
            if _shows(candidate, state.p_w[None, :2])[0] and tried.is_new(state.p_w[None, :2])[0]:
                if not tried.stands:
                    tried.stood_w.append(state.p_w[:2].copy())
                    tried.until_s = state.stamp_s + _STANDS_S
                step = candidate.centre_w - state.p_w[:2]
                return float(np.arctan2(step[1], step[0]))
        return None

    def once_more(self, now_s: float) -> None:
        """What was looked at and given up is worth another look: there is nothing else to do."""
        for tried in (self._of(candidate) for candidate in self._candidates):
            if now_s >= tried.until_s and tried.stands and tried.times < _TIMES:
                tried.times, tried.until_s = tried.times + 1, np.inf

    def carry(self, update: MapUpdate) -> None:
        """Take the places along with the map; candidates come anew."""
        for tried in self._tried:
            places = update.points(np.array([tried.centre_w, *tried.stood_w]))
            tried.centre_w, tried.stood_w = places[0], list(places[1:])
        self._candidates = ()

    def _worth(self, now_s: float) -> list[tuple[Candidate, _Tried]]:
        """Those that were not given up."""
        both = [(candidate, self._of(candidate)) for candidate in self._candidates]
        return [(candidate, tried) for candidate, tried in both if now_s < tried.until_s]

    def _of(self, candidate: Candidate) -> _Tried:
        for tried in self._tried:
            if np.linalg.norm(tried.centre_w - candidate.centre_w) < _SAME_M:
                return tried
        self._tried.append(_Tried(candidate.centre_w.copy()))
        return self._tried[-1]


def _shows(candidate: Candidate, p_w: FloatArray, inside_m: float = 0.0) -> np.ndarray:
    """``(P,)`` whether places ``(P, 2)`` lie before an opening, on the side that it was seen from, and elsewhere, and
    not at the border of that."""
    away = (candidate.place_w - candidate.centre_w) @ candidate.normal_w
    before = (p_w - candidate.centre_w) @ candidate.normal_w * (1.0 if away >= 0 else -1.0)
    aside = np.abs((p_w - candidate.centre_w) @ np.array([-candidate.normal_w[1], candidate.normal_w[0]]))
    elsewhere = np.linalg.norm(p_w - candidate.place_w, axis=1) >= _ELSEWHERE_M + inside_m
    elsewhere |= not candidate.elsewhere
    apart = (before >= _BEFORE_M[0] + inside_m) & (before <= _BEFORE_M[1] - inside_m)
    return np.asarray(apart & (aside <= _ASIDE * before - inside_m) & elsewhere)
