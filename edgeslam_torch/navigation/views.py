"""Next best view: what to look at from here, and where to look from next, by what a view would show.

Views are wanted of unknown cells that block the path, of borders of the free space, where a door may be, and of
undecided openings: from a single viewpoint they are indistinguishable from a gap between objects or a depth error.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.exit_tracker import FARTHEST_M, FIELD_RAD, PLACES_M, Candidate
from edgeslam_torch.navigation.openings.exits import NARROWEST_M
from edgeslam_torch.types import FloatArray

EVERY_M = 1.2
"""Distance between places of looking around: a door of 0.85 m is seen from two. What stays unknown from within it lies
outside the vertical field of view."""
_RISE_M = 0.25
"""A Tello's camera is tilted down: from here above the flight height it sees that height from 0.6 m on."""
_THERE_RAD, _THERE_M = math.radians(8.0), 0.06
"""Errors of heading and height with which a view is taken."""
_STANDS_S = 0.6
"""Duration of a view: three depth maps at 5 Hz, of which two free a cell."""
_OPENING_S = 1.2
"""The same of an opening: two updates of its odds, as much as one viewpoint may add."""
_PASSED_M = NavLimits().clearance_m(0.0)
"""Distance from obstacles at which the drone passes: what is closer to one is unreachable. Distance that counts as
arrived at a viewpoint."""
_SQUARELY_COS = math.cos(math.radians(40.0))
"""Maximum angle to a border's normal for a frontal view: half a metre is visible through a door in a 10 cm wall."""
_BEFORE_M, _BEFORE_COS = (0.8, 2.0), math.cos(math.radians(17.0))
"""Distances in front of the wall at which an opening fits into the field of view and depth is reliable, and maximum
angle: from farther aside the far jamb hides the space behind."""
_LARGE_M2 = 0.5
"""Smaller non-free regions are furniture, not walls."""
_MOST = 8
"""Maximum number of viewpoints."""
_COARSE, _STEP_DEG = 3, 15.0
"""Steps between candidate viewpoints [cells] and headings [degrees]."""


@dataclass(frozen=True, slots=True)
class Look:
    """A view to be taken from here."""

    heading_rad: float
    rise_m: float = 0.0
    """Above the flight height."""
    stands_s: float = _STANDS_S


@dataclass(frozen=True, slots=True)
class Targets:
    """What frontal views shall show: border cells of the free space, and undecided openings."""

    p_w: FloatArray
    """``(N, 2)`` [m]."""
    normal_w: FloatArray
    """``(N, 2)`` unit normals into the free space."""
    range_m: FloatArray
    """``(N, 2)`` nearest and farthest distance of a view that resolves each."""
    cos: FloatArray
    """``(N,)`` of the largest angle to the normal from which a view resolves each."""
    width_m: FloatArray
    """``(N,)``."""

    def __getitem__(self, some: np.ndarray) -> "Targets":
        return Targets(self.p_w[some], self.normal_w[some], self.range_m[some], self.cos[some], self.width_m[some])

    def before(self, here_w: FloatArray) -> np.ndarray:
        """``(M, N)`` whether each is visible frontally and in range from points ``(M, 2)``."""
        step = here_w[:, None] - self.p_w
        away = np.linalg.norm(step, axis=-1)
        in_range = (away > self.range_m[:, 0]) & (away < self.range_m[:, 1])
        return np.asarray(in_range & ((step * self.normal_w).sum(-1) > self.cos * away))


def borders(layer: Layer, here_w: FloatArray) -> Targets:
    """Borders of the connected free space around a point ``(2,)``, towards walls or unknown cells."""
    wide = layer.clearance_m >= 1.5 * layer.cell_m  # narrower free space is a gap between rays
    mine = ndimage.binary_dilation(layer.part_around(wide, here_w), iterations=2) & layer.free
    closed, count = ndimage.label(~layer.free)
    sizes = np.bincount(closed.ravel(), minlength=count + 1) * layer.cell_m**2
    sizes[0] = 0.0
    edge = ndimage.binary_dilation(mine) & (sizes[closed] >= _LARGE_M2)
    smooth = ndimage.gaussian_filter(mine.astype(np.float32), 2.0)
    normal = np.stack([g[edge] for g in np.gradient(smooth)], axis=1).astype(np.float64)
    length = np.linalg.norm(normal, axis=1)
    good = length > 1e-3
    farthest = np.where(layer.from_solid_m[edge] > _PASSED_M, EVERY_M, FARTHEST_M)[good]
    p_w = layer.centres(np.argwhere(edge)[good]).reshape(-1, 2)
    range_m = np.stack([np.full(len(p_w), 0.5 * EVERY_M), farthest], axis=1)
    some = np.ones(len(p_w))
    return Targets(p_w, normal[good] / length[good, None], range_m, some * _SQUARELY_COS, some * layer.cell_m)


_NOTHING = Targets(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@dataclass(slots=True)
class Coverage:
    """Record of camera positions and headings."""

    _places: Places = field(default_factory=Places)
    _headings: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(V,)`` [rad]; the effect of map corrections on them is negligible."""

    def note(self, state: DroneState) -> None:
        """Add the current view; dead-reckoned poses and repeated views are left out."""
        near = np.linalg.norm(self._places.p_w - state.p_w[:2], axis=1) < 0.5 * PLACES_M
        similar = np.abs(wrapped(self._headings - state.yaw_rad)) < _THERE_RAD
        if state.tracked and not (near & similar).any():
            self._places.add(state.views, state.p_w[:2])
            self._headings = np.append(self._headings, state.yaw_rad)

    def unlooked(self, all_: Targets) -> Targets:
        """Targets that no view has shown."""
        places_w = self._places.p_w
        step = all_.p_w - places_w[:, None]
        bearing = np.arctan2(step[..., 1], step[..., 0]) - self._headings[:, None]
        shown = all_.before(places_w) & (np.abs(wrapped(bearing)) < FIELD_RAD)
        return all_[np.flatnonzero(~shown.any(axis=0))]


@dataclass(slots=True)
class ViewPlanner:
    """Chooses and takes views until none would show more.

    Args:
        half_m: Half the height of the space that the drone needs.
        limits: Flight height, rates of turn and climb.
    """

    half_m: float
    limits: NavLimits = field(default_factory=NavLimits)
    openings: Sequence[Candidate] = ()
    """Undecided openings."""
    look: Look | None = None
    """The view that is being taken."""
    exhausted: Places = field(default_factory=Places)
    """The last place from which no view shows more of the path."""
    _has_looked: bool = False
    """Whether the first view of the flight was begun; it may have come before the scale, and counts for no place."""
    _place: Places = field(default_factory=Places)
    _taken: list[Look] = field(default_factory=list)
    """Views taken there."""
    _since_s: float = math.nan
    """Start of the view that is being taken."""
    _stands_s: float = math.nan
    """Since when the drone has had this position and heading."""
    _coverage: Coverage = field(default_factory=Coverage)
    _left: Targets = _NOTHING
    """Borders that no view has shown, at the last call of `viewpoints`."""
    _goals: Places = field(default_factory=Places)
    """Viewpoints at that call."""
    _around: Places = field(default_factory=Places)
    """Places from which it looked around."""
    _goes_on: bool = False
    """Whether it is looking around at the last of them."""

    def take(self, look: Look, state: DroneState) -> None:
        """Begin a view."""
        self.look, self._since_s, self._stands_s = look, state.stamp_s, math.nan

    def taking(self, state: DroneState) -> Look | None:
        """The view that is being taken; a tracking loss ends it. Call it for every state."""
        self._coverage.note(state)
        if self.look is None:
            return None
        turned = abs(state.turn_to_rad(self.look.heading_rad)) < _THERE_RAD
        if not turned or abs(state.p_w[2] - self.limits.height_m - self.look.rise_m) > _THERE_M:
            self._stands_s = math.nan
        elif math.isnan(self._stands_s):
            self._stands_s = state.stamp_s
        turn_s = 2.0 * math.pi / self.limits.turn_rad_s  # half a turn takes half of it
        late = state.stamp_s - self._since_s > turn_s + self.look.stands_s
        if late or state.stamp_s - self._stands_s > self.look.stands_s or not state.tracked:
            self._taken.append(self.look)
            self.look, self._goes_on = None, self._goes_on and state.tracked
        return self.look

    def start_over(self) -> None:
        """The grid was reset: views taken here may be taken again."""
        self._taken, self.exhausted = [], Places()

    def look_first(self, state: DroneState) -> bool:
        """Begin the first view of a flight, ahead and from above: after take-off the space just ahead is below the
        picture. False after it."""
        if self._has_looked:
            return False
        self._has_looked = True
        self.take(Look(state.yaw_rad, _RISE_M), state)
        return True

    def look_along(self, unseen_w: FloatArray, ahead_rad: float, view: View | None, state: DroneState) -> bool:
        """Begin the view that shows most unknown cells ``(U, 2)`` of a path a second; False if none shows any.

        Args:
            unseen_w: Unknown cells that block the path.
            ahead_rad: Bearing of the path.
            view: Any view of the camera; before the first one there is none to choose.
            state: The drone's state.
        """
        here = state.p_w[:2]
        if view is not None:
            looks = [Look(heading, rise_m) for rise_m in (0.0, _RISE_M) for heading in _all_round(ahead_rad)]
            cell = np.ones(len(unseen_w))
            if self._begin(looks, lambda look: self._shows(look, unseen_w, here, view), cell, 1.0, state):
                return True
        elif len(unseen_w):
            return True
        self.exhausted = Places(state.views, here)
        return False

    def look_around(self, state: DroneState) -> bool:
        """Begin the view from here that shows most of the borders and openings a second.

        False if it shows less than half a door's width, or another look around was near by.
        """
        here, targets = state.p_w[:2], self._targets()
        if not state.tracked:
            return False
        if self._goes_on:
            self._around.keep(slice(-1))
        targets = targets[self._shown_anew(here[None], 0.8)[0]]
        worth = targets.width_m.sum() >= NARROWEST_M or self._goals.is_near(here, _PASSED_M)
        if not self._goes_on and not worth:
            return False
        self._around.add(state.views, here)
        bearing = np.arctan2(*(targets.p_w - here).T[::-1])

        def shows(look: Look) -> np.ndarray:
            return np.asarray(np.abs(wrapped(bearing - look.heading_rad)) < FIELD_RAD - _THERE_RAD)

        looks = [Look(heading, stands_s=0.0) for heading in _all_round(state.yaw_rad)]
        self._goes_on = self._begin(looks, shows, targets.width_m, 0.5 * NARROWEST_M, state)
        if self.look is not None and (targets.width_m[shows(self.look)] == NARROWEST_M).any():
            self.look = replace(self.look, stands_s=_OPENING_S)
        return self._goes_on

    def viewpoints(self, layer: Layer, state: DroneState) -> np.ndarray:
        """Cells ``(G, 2)`` to look around from, greedily by the width of targets that each adds."""
        here = state.p_w[:2]
        self._left = self._coverage.unlooked(borders(layer, here))
        cells = np.argwhere(layer.free & (layer.from_solid_m > _PASSED_M))
        passable = layer.part_around(layer.from_solid_m > _PASSED_M - 0.5 * layer.cell_m, here)
        cells = cells[passable[tuple(cells.T)] & (cells % _COARSE == 0).all(axis=1)]
        p_w, width_m = layer.centres(cells).reshape(-1, 2), self._targets().width_m
        away_m, shown = np.linalg.norm(p_w - here, axis=1), self._shown_anew(p_w)
        chosen: list[int] = []
        while len(cells) and len(chosen) < _MOST:
            gain_m = shown @ width_m
            best = int(np.argmax(np.where(gain_m >= NARROWEST_M, gain_m - 0.1 * away_m, -np.inf)))
            if gain_m[best] < NARROWEST_M:
                break
            chosen.append(best)
            shown &= ~shown[best]
        self._goals = Places(state.views, p_w[chosen])
        return np.asarray(cells[chosen])

    def _targets(self) -> Targets:
        """Borders and openings."""
        left, some = self._left, np.ones(len(self.openings))
        centre_w = np.array([opening.centre_w for opening in self.openings]).reshape(-1, 2)
        normal_w = np.array([-opening.normal_w for opening in self.openings]).reshape(-1, 2)
        return Targets(
            np.concatenate([left.p_w, centre_w]),
            np.concatenate([left.normal_w, normal_w]),
            np.concatenate([left.range_m, some[:, None] * _BEFORE_M]),
            np.concatenate([left.cos, some * _BEFORE_COS]),
            np.concatenate([left.width_m, some * NARROWEST_M]),
        )

    def _shown_anew(self, p_w: FloatArray, share: float = 1.0) -> np.ndarray:
        """``(P, N)`` which of the targets are visible from points ``(P, 2)`` that are far from earlier viewpoints."""
        shown, away = self._targets().before(p_w), self._around.away_m(p_w)
        shown[:, : len(self._left.p_w)] &= (away > share * EVERY_M)[:, None]
        for k, opening in enumerate(self.openings, len(self._left.p_w)):
            saturated = np.linalg.norm(p_w[:, None] - opening.saturated_w, axis=2).min(axis=1, initial=math.inf)
            shown[:, k] &= np.minimum(away, saturated) > share * PLACES_M
        return shown

    def _begin(
        self,
        looks: Sequence[Look],
        shows: Callable[[Look], np.ndarray],
        width: FloatArray,
        least: float,
        state: DroneState,
    ) -> bool:
        """Begin the look that shows most a second, of what the views taken from here do not show.

        Args:
            looks: Candidates.
            shows: ``(N,)`` which of the targets a view shows.
            width: ``(N,)`` what each of them counts.
            least: Minimum of what it must show together.
            state: The drone's state.
        """
        if not self._place.is_near(state.p_w[:2], PLACES_M):
            self._place, self._taken = Places(state.views, state.p_w[:2]), []
        width = width * ~np.any([shows(look) for look in self._taken], axis=0) if self._taken else width
        best, most = None, 0.0
        for look in looks:
            climb_m = abs(self.limits.height_m + look.rise_m - float(state.p_w[2])) + look.rise_m
            turn_s = abs(state.turn_to_rad(look.heading_rad)) / self.limits.turn_rad_s
            gain = float(width[shows(look)].sum())
            a_second = gain / (max(turn_s, climb_m / self.limits.climb_m_s) + _STANDS_S)
            if gain >= least - 1e-9 and a_second > most:
                best, most = look, a_second
        if best is not None:
            self.take(best, state)
        return best is not None

    def _shows(self, look: Look, p_w: FloatArray, here: FloatArray, view: View) -> np.ndarray:
        """Which of the columns at points ``(U, 2)`` lie in the picture over their whole height."""
        c, s = math.cos(look.heading_rad), math.sin(look.heading_rad)
        mount, K = camera_on_body(), view.K
        shown = np.ones(len(p_w), dtype=bool)
        for z_m in (-self.half_m - look.rise_m, self.half_m - look.rise_m):
            step = p_w - here
            p_b = np.column_stack([step @ [c, s], step @ [-s, c], np.full(len(p_w), z_m)])
            p_c = (p_b - mount[:3, 3]) @ mount[:3, :3]
            z = np.maximum(p_c[:, 2], 1e-6)
            uv = p_c[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
            inside = ((uv > -0.5) & (uv < np.array(view.depth_m.shape[::-1]) - 0.5)).all(axis=1)
            shown &= inside & (p_c[:, 2] > 0.0)
        return shown


def _all_round(first_rad: float) -> FloatArray:
    """Headings."""
    return first_rad + np.radians(np.arange(0.0, 360.0, _STEP_DEG))
