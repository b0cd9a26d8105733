"""View planner of exploration: viewpoints and headings by the information expected of a view.

A view is informative about borders of the free space that no view has covered frontally, where a door may be, and about
openings that are undecided: from a single viewpoint they are indistinguishable from a gap between two objects or a
depth error.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.coverage import Borders, Coverage, borders
from edgeslam_torch.navigation.exploring.frontiers import PASSED_M, reachable
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import FIELD_RAD, PLACES_M, Candidate
from edgeslam_torch.navigation.openings.exits import NARROWEST_M
from edgeslam_torch.types import FloatArray

_EVERY_M = 1.2
"""Distance between looks around: a door of 0.85 m is seen from two places; and of a viewpoint that is no detour."""
_THERE_M = 0.25
"""Distance that counts as arrived; the planner comes no closer."""
_BEFORE_M = (0.8, 2.0)
"""Distances in front of the wall at which an opening fits into the field of view and depth is reliable."""
_ASIDE = 0.3
"""Lateral offset of the viewpoint over that distance: 17 degrees. From farther aside the far jamb hides the space
behind."""
_INSIDE_M = 0.15
"""Margin of viewpoints inside that region: the planner stops slightly short of a goal."""
_COARSE = 3
"""Subsampling of candidate viewpoints in cells."""
_MOST = 8
"""Maximum number of viewpoints for borders."""
_THERE_RAD = math.radians(4.0)
_SHOWN_RAD = FIELD_RAD - _THERE_RAD
"""Half-angle covered when a heading is reached."""
_STANDS_S = 4.0
"""Longest look at an opening: a right-angle turn and five views."""
_GIVEN_UP_S = 16.0
"""Timeout of a look around: one and a half turns at 60 deg/s plus pauses, and half as much again."""
_SOUGHT_S = 30.0
"""Timeout of the flight to a viewpoint before an opening: six metres and one look around."""


@dataclass(slots=True)
class ViewPlanner:
    """Proposes viewpoints and headings until no view would be informative."""

    stands_s: float = 0.0
    """Duration of a view at each heading; without it the views in passing count."""
    _coverage: Coverage = field(default_factory=Coverage)
    _left: Borders = field(default_factory=lambda: Borders(np.zeros((0, 2)), np.zeros((0, 2)), 0.0))
    """Borders not covered at the last call."""
    _openings: Sequence[Candidate] = ()
    """Undecided openings."""
    _places: Places = field(default_factory=Places)
    """Positions of earlier looks around."""
    _spent: Places = field(default_factory=Places)
    """Viewpoints before openings that yielded nothing more, or that were not reached."""
    _headings: list[float] = field(default_factory=list)
    """Remaining headings, last first."""
    _since_s: float = math.nan
    """Start of the look around."""
    _stands_s: float = math.nan
    """Start of the look at an opening."""
    _faces_s: float = math.nan
    """Since when the drone faces the last of the headings."""
    _sought_s: float = math.nan
    """Since when a viewpoint before an opening is sought."""

    def looks_from(self, here_w: FloatArray) -> bool:
        """Whether a look from a point ``(2,)`` is under way or informative."""
        return bool(self._headings) or self._is_new(here_w)

    def consider(self, openings: Sequence[Candidate]) -> None:
        """Set the undecided openings."""
        self._openings = openings

    def goals(
        self, layer: Layer, state: DroneState, frontier: np.ndarray, among: np.ndarray | None = None
    ) -> np.ndarray:
        """Viewpoint cells ``(G, 2)``: those before openings close by, else all, with those ``(F, 2)`` at a frontier.

        Args:
            layer: Current layer.
            state: Current state.
            frontier: Cells at a frontier.
            among: Cells ``(M, 2)`` that may be viewpoints; all free ones when None.
        """
        here = state.p_w[:2]
        self._left = self._coverage.unlooked(borders(layer, here))
        free = np.argwhere(layer.free & (layer.from_solid_m > PASSED_M)) if among is None else among
        cells = reachable(free, layer, here)
        p_w = layer.centres(cells).reshape(-1, 2)
        informative = self._informative(p_w, _INSIDE_M)
        near = informative & (np.linalg.norm(p_w - here, axis=1) <= _EVERY_M)
        self._seek(p_w[informative], state)
        if near.any():
            return np.asarray(cells[near])
        coarse = cells[(cells % _COARSE == 0).all(1)]
        return np.concatenate([frontier, cells[informative], self._before_borders(coarse, layer, here)])

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to turn to; None to face ahead. A tracking loss ends the look."""
        self._coverage.note(state)
        here = state.p_w[:2]
        if (opening := self._opening_at(here)) is not None:
            self._stands_s = state.stamp_s if math.isnan(self._stands_s) else self._stands_s
            if state.stamp_s - self._stands_s <= _STANDS_S:
                step = opening.centre_w - here
                return math.atan2(step[1], step[0])
            self._spent.add(state.views, here)
        self._stands_s = math.nan
        if not self._headings and self._is_new(here):
            self._places.add(state.views, here)
            self._headings = [state.yaw_rad + turn for turn in reversed(_in_turn(self._sides(here, state.yaw_rad)))]
            self._since_s = state.stamp_s
        if not state.tracked or state.stamp_s - self._since_s > _GIVEN_UP_S:
            self._headings = []
        while self._headings and abs(state.turn_to_rad(self._headings[-1])) < _THERE_RAD:
            self._faces_s = state.stamp_s if math.isnan(self._faces_s) else self._faces_s
            if state.stamp_s - self._faces_s < self.stands_s:
                break
            self._headings.pop()
            self._faces_s = math.nan
        return self._headings[-1] if self._headings else None

    def _informative(self, p_w: FloatArray, inside_m: float = 0.0) -> np.ndarray:
        """``(P,)`` whether a view from points ``(P, 2)`` is informative about an opening."""
        seen = [_informative(opening, p_w, inside_m) for opening in self._openings]
        return np.any(seen, axis=0) & (self._spent.away_m(p_w) >= PLACES_M) if seen else np.zeros(len(p_w), bool)

    def _opening_at(self, here_w: FloatArray) -> Candidate | None:
        """An opening about which a view from here is informative."""
        if not self._informative(here_w[None])[0]:
            return None
        return next(opening for opening in self._openings if _informative(opening, here_w[None])[0])

    def _seek(self, spots_w: FloatArray, state: DroneState) -> None:
        """Give up the nearest viewpoint before an opening if none was reached for long."""
        if len(spots_w) == 0 or not math.isnan(self._stands_s):
            self._sought_s = math.nan
        elif math.isnan(self._sought_s):
            self._sought_s = state.stamp_s
        elif state.stamp_s - self._sought_s > _SOUGHT_S:
            nearest = int(np.argmin(np.linalg.norm(spots_w - state.p_w[:2], axis=1)))
            self._spent.add(state.views, spots_w[nearest])
            self._sought_s = math.nan

    def _before_borders(self, cells: np.ndarray, layer: Layer, here: FloatArray) -> np.ndarray:
        """Some of the cells, greedily by the uncovered border length that each adds."""
        p_w = layer.centres(cells).reshape(-1, 2)
        away = np.linalg.norm(p_w - here, axis=1)
        shown = self._left.before(p_w) & (self._places.away_m(p_w) > _EVERY_M)[:, None]
        chosen: list[int] = []
        while len(cells) and len(chosen) < _MOST:
            gain_m = shown.sum(1) * self._left.cell_m
            best = int(np.argmax(np.where(gain_m >= NARROWEST_M, gain_m - 0.1 * away, -np.inf)))
            if gain_m[best] < NARROWEST_M:
                break
            chosen.append(best)
            shown &= ~shown[best]
        return np.asarray(cells[chosen])

    def _is_new(self, here_w: FloatArray) -> bool:
        """Whether to look from here: far enough from earlier looks, with enough to see."""
        far = float(self._places.away_m(here_w)) > _EVERY_M - _THERE_M
        return far and bool(self._left.before(here_w[None]).sum() * self._left.cell_m >= NARROWEST_M)

    def _sides(self, here_w: FloatArray, yaw_rad: float) -> list[float]:
        """Turns from the current heading that cover the borders visible from here, greedily."""
        step = self._left.p_w[self._left.before(here_w[None])[0]] - here_w
        left = np.asarray(wrapped(np.arctan2(step[:, 1], step[:, 0]) - yaw_rad))
        tried = np.arange(-175.0, 180.0, 5.0) * math.pi / 180.0
        found: list[float] = []
        while len(left):
            shown = np.abs(wrapped(left - tried[:, None])) < _SHOWN_RAD
            best = int(np.argmax(shown.sum(1)))
            if shown[best].sum() * self._left.cell_m < 0.5 * NARROWEST_M:
                break
            found.append(float(tried[best]))
            left = left[~shown[best]]
        return found


def _informative(opening: Candidate, p_w: FloatArray, inside_m: float = 0.0) -> np.ndarray:
    """``(P,)`` whether an opening is visible from points ``(P, 2)`` on the side from which it was detected, at least
    ``inside_m`` inside this region, and away from saturated viewpoints."""
    before = (opening.centre_w - p_w) @ opening.normal_w
    aside = np.abs((p_w - opening.centre_w) @ np.array([-opening.normal_w[1], opening.normal_w[0]]))
    in_range = (before >= _BEFORE_M[0] + inside_m) & (before <= _BEFORE_M[1] - inside_m)
    fresh = np.linalg.norm(p_w[:, None] - opening.saturated_w, axis=-1).min(axis=1, initial=math.inf)
    return np.asarray(in_range & (aside <= _ASIDE * before - inside_m) & (fresh >= PLACES_M + inside_m))


def _in_turn(turns_rad: list[float]) -> list[float]:
    """Nearest-neighbour order of turns."""
    left, order = np.array(turns_rad), [0.0]
    while len(left):
        nearest = int(np.argmin(np.abs(wrapped(left - order[-1]))))
        order.append(float(left[nearest]))
        left = np.delete(left, nearest)
    return order[1:]
