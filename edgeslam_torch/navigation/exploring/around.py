"""Selection of viewpoints and headings during exploration: borders that the camera has not covered."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.coverage import Borders, Coverage, borders
from edgeslam_torch.navigation.exploring.frontiers import reachable
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import FIELD_RAD
from edgeslam_torch.types import FloatArray

_EVERY_M = 1.2
"""Distance between looks along the path: a door of 0.85 m is seen from two places."""
_AGAIN_M = 0.4
"""Distance from an earlier look below which nothing new is visible."""
_THERE_M = 0.25
"""Distance that counts as arrived; the planner comes no closer."""
_WORTH_M = 0.6
"""Minimum length of uncovered border for a look: the narrowest exit."""
_REST_M = 0.3
"""Remaining length in one direction that is ignored."""
_PASSED_M = 0.3
"""Distance of viewpoints from obstacles."""
_COARSE = 3
"""Subsampling of candidate viewpoints in cells."""
_MOST = 8
"""Maximum number of viewpoints."""
_THERE_RAD = math.radians(4.0)
_SHOWN_RAD = FIELD_RAD - _THERE_RAD
"""Half-angle covered when a heading is reached."""
_GIVEN_UP_S = 16.0
"""Timeout of a look: one and a half turns at 60 deg/s plus pauses, and half as much again."""


@dataclass(slots=True)
class LooksAround:
    """Proposes viewpoints and headings until all borders are covered."""

    _coverage: Coverage = field(default_factory=Coverage)
    _left: Borders = field(default_factory=lambda: Borders(np.zeros((0, 2)), np.zeros((0, 2)), 0.0))
    """Borders not covered at the last call."""
    _spots_w: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """``(G, 2)`` viewpoints of these."""
    _places: Places = field(default_factory=Places)
    """Positions of earlier looks."""
    _headings: list[float] = field(default_factory=list)
    """Remaining headings, last first."""
    _since_s: float = math.nan

    def goals(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Viewpoint cells ``(G, 2)``, greedily by the uncovered border length that each adds."""
        here = state.p_w[:2]
        self._left = self._coverage.unlooked(borders(layer, here))
        free = layer.free[::_COARSE, ::_COARSE] & (layer.from_solid_m[::_COARSE, ::_COARSE] > _PASSED_M)
        cells = reachable(np.argwhere(free) * _COARSE, layer, here)
        p_w = layer.centres(cells).reshape(-1, 2)
        away = np.linalg.norm(p_w - here, axis=1)
        shown = self._left.before(p_w) & (self._away_m(p_w) > _AGAIN_M)[:, None]
        chosen: list[int] = []
        while len(cells) and len(chosen) < _MOST:
            gain_m = shown.sum(1) * self._left.cell_m
            best = int(np.argmax(np.where(gain_m >= _WORTH_M, gain_m - 0.1 * away, -np.inf)))
            if gain_m[best] < _WORTH_M:
                break
            chosen.append(best)
            shown &= ~shown[best]
        self._spots_w = p_w[chosen]
        return np.asarray(cells[chosen])

    def heading_rad(self, state: DroneState) -> float | None:
        """Heading to turn to; None to face ahead. A tracking loss ends the look."""
        self._coverage.note(state)
        here = state.p_w[:2]
        if not self._headings and self._is_new(here):
            self._places.add(state.views, here)
            self._headings = [state.yaw_rad + turn for turn in reversed(_in_turn(self._sides(here, state.yaw_rad)))]
            self._since_s = state.stamp_s
        if not state.tracked or state.stamp_s - self._since_s > _GIVEN_UP_S:
            self._headings = []
        while self._headings and abs(float(wrapped(np.array(self._headings[-1] - state.yaw_rad)))) < _THERE_RAD:
            self._headings.pop()
        return self._headings[-1] if self._headings else None

    def _away_m(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(P, 2)`` from the nearest earlier look; infinite without one."""
        return np.asarray(np.linalg.norm(p_w[:, None] - self._places.p_w, axis=-1).min(axis=1, initial=math.inf))

    def _is_new(self, here_w: FloatArray) -> bool:
        """Whether to look from here: far enough from earlier looks with enough to see, or at a viewpoint."""
        away_m = float(self._away_m(here_w[None])[0])
        if away_m > _EVERY_M:
            return bool(self._left.before(here_w[None]).sum() * self._left.cell_m >= _WORTH_M)
        there = (np.linalg.norm(self._spots_w - here_w, axis=1) < _THERE_M).any()
        return bool(there) and away_m > _AGAIN_M - _THERE_M

    def _sides(self, here_w: FloatArray, yaw_rad: float) -> list[float]:
        """Turns from the current heading that cover the borders visible from here, greedily."""
        step = self._left.p_w[self._left.before(here_w[None])[0]] - here_w
        left = np.asarray(wrapped(np.arctan2(step[:, 1], step[:, 0]) - yaw_rad))
        tried = np.arange(-175.0, 180.0, 5.0) * math.pi / 180.0
        found: list[float] = []
        while len(left):
            shown = np.abs(wrapped(left - tried[:, None])) < _SHOWN_RAD
            best = int(np.argmax(shown.sum(1)))
            if shown[best].sum() * self._left.cell_m < _REST_M:
                break
            found.append(float(tried[best]))
            left = left[~shown[best]]
        return found


def _in_turn(turns_rad: list[float]) -> list[float]:
    """Nearest-neighbour order of turns."""
    left, order = np.array(turns_rad), [0.0]
    while len(left):
        nearest = int(np.argmin(np.abs(wrapped(left - order[-1]))))
        order.append(float(left[nearest]))
        left = np.delete(left, nearest)
    return order[1:]
