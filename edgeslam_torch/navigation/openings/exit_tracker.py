"""Tracks of openings over a flight: the log-odds that a body passes, and position and width with their covariance."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.openings.depth_rays import DepthRays
from edgeslam_torch.navigation.openings.exits import SAME_M, WIDEST_M, Gap, has_detour, openings
from edgeslam_torch.navigation.openings.wall_frame import CELL_SIGMAS, Walls, along_walls
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.types import FloatArray

_EVERY_S = 0.5
SAME_COS = math.cos(math.radians(35.0))
"""Maximum angle between directions that belong to the same opening or wall."""
_PASSAGE_M = 1.0
"""Minimum distance between two doors along a passage."""
PLACES_M = SAME_M
"""Minimum distance between distinct viewpoints."""
FIELD_RAD = math.radians(20.0)
"""Half the field of view less a margin; an opening inside it that is not detected counts as missed."""
_SQUARELY_COS = math.cos(math.radians(50.0))
"""Maximum angle to an opening's normal for a valid view."""
_NEAREST_M, FARTHEST_M = 0.8, 2.5
"""Range of valid views: closer, an opening exceeds the field of view; farther, depth errors open and close it."""
_NEAR_M = 4.0
"""Maximum distance of a detection; beyond it a door covers a few pixels of uncertain depth."""
_STEP_M = 1.0
"""Maximum distance between updates for which the crossing of an opening is detected."""
_PRIOR, _LIMIT = -1.5, 3.0
"""Log-odds of a new detection, of which one in five is an opening, and their bound, which lets later views of a better
map outweigh any number of earlier ones."""
_HIT, _MISS, _HINT = 1.0, -0.25, 0.75
"""Log-odds of a valid view that detects an opening, of one that does not (an open door is missed in every second view,
a closed one in nearly all), and of a hint: a detection at a grazing angle or with cells that are not free, or rays
that pass the wall."""
_HINTED = 0.25
"""Bound for hints: light passes, a body may not."""
_VIEWPOINT = 2.0
"""Bound of the log-odds by views from one viewpoint, which share their errors of depth."""
_UNDECIDED, _OPEN = 0.0, 1.5
"""Log-odds from which another view is worth a detour, and from which an opening is reported; one viewpoint is not
enough for this."""
_PARTS, _PARTS_LIMIT = 0.2, 4.0
"""Log-odds, and their bound, of a view with or without a known way around: it comes and goes as the map is built."""
_NOISE_M, _DRIFT_M = 0.1, 0.02
"""Standard deviation of a detected position or width, one cell, and of its change by the next detection."""


@dataclass(frozen=True, slots=True)
class Exit:
    """An opening of a door's width in a wall, free on both sides, seen from at least two places."""

    centre_w: FloatArray
    """``(3,)`` centre at the height of the drone, in the drone's world [m]."""
    normal_w: FloatArray
    """``(3,)`` horizontal unit normal, pointing away from the first viewpoint."""
    width_m: float
    width_sigma_m: float
    position_sigma_m: float
    """Standard deviation of each horizontal coordinate of the centre, relative to the drone [m]."""
    places: int
    """Number of distinct viewpoints."""

    def beyond(self, away_m: float) -> FloatArray:
        """Point ``(3,)`` at a distance behind the exit; in front of it if negative."""
        return np.asarray(self.centre_w + away_m * self.normal_w)


@dataclass(frozen=True, slots=True)
class Candidate:
    """An opening of which views do not say yet whether a body passes."""

    centre_w: FloatArray
    """``(2,)`` [m]."""
    normal_w: FloatArray
    """``(2,)`` unit normal, away from the first viewpoint."""
    saturated_w: FloatArray
    """``(N, 2)`` viewpoints whose evidence has reached its bound [m]."""


class _Track:
    """State of one opening, tied to the view in which it was first detected.

    Args:
        gap: The first detection.
        state: The drone's state at that time.
    """

    def __init__(self, gap: Gap, state: DroneState) -> None:
        self.odds, self.parts = _PRIOR, 0.0
        """Log-odds that a body passes, and that it parts two rooms."""
        self._ends = Places(state.views, [gap.centre_w, gap.centre_w + gap.width_m * gap.normal_w])
        self.variance = _NOISE_M**2
        """Of each coordinate of the centre, and of the width [m^2]."""
        self.viewpoints = Places(state.views, state.p_w[:2])
        self._evidence = [0.0]
        """Log-odds by the views from each viewpoint."""

    @property
    def centre_w(self) -> FloatArray:
        """``(2,)``."""
        return np.asarray(self._ends.p_w[0])

    @property
    def normal_w(self) -> FloatArray:
        """``(2,)`` unit normal, away from the first viewpoint."""
        centre, tip = self._ends.p_w
        return np.asarray((tip - centre) / np.linalg.norm(tip - centre))

    @property
    def width_m(self) -> float:
        """Width of the opening."""
        centre, tip = self._ends.p_w
        return float(np.linalg.norm(tip - centre))

    def is_at(self, gap: Gap) -> bool:
        """Whether a detection belongs to it; the sign of the normal depends on the side of the drone."""
        near = float(np.linalg.norm(gap.centre_w - self.centre_w)) < SAME_M
        return near and abs(float(gap.normal_w @ self.normal_w)) > SAME_COS

    def measure(self, gap: Gap) -> None:
        """Kalman update of centre, normal and width."""
        before = self.variance + _DRIFT_M**2
        gain = before / (before + _NOISE_M**2)
        self.variance = (1.0 - gain) * before
        normal = gap.normal_w * (1.0 if gap.normal_w @ self.normal_w >= 0.0 else -1.0)
        measured = np.array([gap.centre_w, gap.centre_w + gap.width_m * normal])
        self._ends.move(self._ends.p_w + gain * (measured - self._ends.p_w))

    def add(self, log_odds: float, state: DroneState, most: float = _LIMIT) -> None:
        """Add the log-odds of a view, in total up to ``most``."""
        away = np.linalg.norm(self.viewpoints.p_w - state.p_w[:2], axis=1)
        at = int(np.argmin(away))
        if away[at] >= PLACES_M:
            at = len(away)
            self.viewpoints.add(state.views, state.p_w[:2])
            self._evidence.append(0.0)
        step = float(np.clip(self._evidence[at] + log_odds, -_VIEWPOINT, _VIEWPOINT)) - self._evidence[at]
        after = max(min(self.odds + step, max(most, self.odds)), -_LIMIT)
        if step and math.isfinite(self.odds):
            self._evidence[at], self.odds = self._evidence[at] + after - self.odds, after

    def note_way_round(self, known: bool) -> None:
        """Add a view with or without a known way around."""
        self.parts = float(np.clip(self.parts + (-_PARTS if known else _PARTS), -_PARTS_LIMIT, _PARTS_LIMIT))

    @property
    def places(self) -> int:
        """Number of viewpoints whose evidence is positive."""
        return sum(log_odds > 0.0 for log_odds in self._evidence)

    @property
    def saturated_w(self) -> FloatArray:
        """``(N, 2)`` viewpoints whose evidence has reached its bound."""
        return self.viewpoints.p_w[np.abs(self._evidence) >= _VIEWPOINT]


@dataclass(slots=True)
class ExitTracker:
    """Detects and tracks exits during a flight."""

    exits: tuple[Exit, ...] = ()
    """Openings that separate two rooms, the nearest first; replaced as a whole, so that other threads may read it."""
    candidates: tuple[Candidate, ...] = ()
    """Undecided openings."""
    _tracks: list[_Track] = field(default_factory=list)
    _looked_s: float = -math.inf
    _looked_w: FloatArray | None = None
    """``(2,)`` position at the last update."""

    def due(self, state: DroneState) -> bool:
        """Whether it is time for an update. Views in a submap whose position is too uncertain do not count."""
        placed = state.metric and state.tracked and state.submap_sigma_m <= DEAD_RECKONING_SIGMA_M
        return placed and state.view is not None and state.stamp_s - self._looked_s >= _EVERY_S

    def look(self, walls: Walls, state: DroneState) -> None:
        """Update with the openings in the current grid and the rays of the current view."""
        self._looked_s = state.stamp_s
        here = state.p_w[:2]
        gaps = openings(along_walls(walls, here))
        rays = DepthRays.of(state.view) if state.view is not None else None
        for track in sorted(self._tracks, key=lambda t: -t.odds):
            gap = next((g for g in gaps if track.is_at(g)), None)
            gaps = [g for g in gaps if g is not gap]
            _update(track, gap, rays, state)
            # A body that passed where no wall was likely, and the map shows none now, has passed no opening.
            likely = gap is not None or track.odds > _UNDECIDED
            if likely and self._looked_w is not None and _leads_through(track, self._looked_w, here):
                track.odds = math.inf
        for gap in gaps:
            if np.linalg.norm(gap.centre_w - here) < _NEAR_M and not any(track.is_at(gap) for track in self._tracks):
                self._tracks.append(_Track(gap, state))
                _update(self._tracks[-1], gap, rays, state)
        self._looked_w = here.copy()
        self._conclude(walls.layer, state)

    def _conclude(self, layer: Layer, state: DroneState) -> None:
        """Exits and candidates by odds and geometry."""
        found: list[Exit] = []
        undecided: list[Candidate] = []
        for track in sorted(self._tracks, key=lambda t: -t.odds):
            if track.odds < _UNDECIDED or track.width_m > WIDEST_M:
                continue
            round_ = has_detour(layer, track.centre_w, track.normal_w, track.width_m)
            if track.odds >= _OPEN:
                if np.linalg.norm(track.centre_w - state.p_w[:2]) < _NEAR_M:  # from afar walls have holes
                    track.note_way_round(round_)
                if track.parts > 0.0 and not any(_one_passage(_exit(track, state), other) for other in found):
                    found.append(_exit(track, state))
            elif not round_:
                undecided.append(Candidate(track.centre_w, track.normal_w, track.saturated_w))
        self.exits = tuple(sorted(found, key=lambda e: float(np.linalg.norm(e.centre_w[:2] - state.p_w[:2]))))
        self.candidates = tuple(undecided)

    def expire(self) -> None:
        """Make an update due, since the map was corrected; the way from the last one is no way that was flown."""
        self._looked_s, self._looked_w = -math.inf, None


def _update(track: _Track, gap: Gap | None, rays: DepthRays | None, state: DroneState) -> None:
    """Sensor model: a hit, a miss or a hint."""
    if gap is not None and gap.leads:
        track.measure(gap)
    valid = _is_looked_at(track, state)
    if gap is not None and gap.is_free and valid:
        track.add(_HIT, state)
    elif gap is not None and (gap.leads or _passes(rays, gap)):
        if np.linalg.norm(gap.centre_w - state.p_w[:2]) < _NEAR_M:
            track.add(_HINT, state, most=_HINTED)
    elif valid:
        track.add(_MISS, state)


def _passes(rays: DepthRays | None, gap: Gap) -> bool:
    return rays is not None and rays.pass_(gap.centre_w, gap.normal_w, gap.width_m)


def _exit(track: _Track, state: DroneState) -> Exit:
    """The opening as measured."""
    away = float(np.linalg.norm(track.centre_w - state.p_w[:2]))
    cell_m, sigma_m = _NOISE_M * CELL_SIGMAS, math.sqrt(track.variance)
    return Exit(
        np.array([*track.centre_w, state.p_w[2]]),
        np.array([*track.normal_w, 0.0]),
        track.width_m,
        math.hypot(cell_m, sigma_m, state.scale_sigma * track.width_m),
        math.hypot(cell_m, sigma_m, state.position_sigma_m, state.scale_sigma * away),
        track.places,
    )


def _one_passage(exit_: Exit, other: Exit) -> bool:
    """Whether two exits are the same opening detected along two wall directions, or a door and an obstacle in front of
    it: one behind the other, closer than two doors."""
    offset, normal = exit_.centre_w - other.centre_w, other.normal_w
    along = abs(float(offset @ normal))
    beside = math.sqrt(max(0.0, float(offset @ offset) - along**2))
    parallel = abs(float(exit_.normal_w @ normal)) > SAME_COS
    behind = parallel and along < _PASSAGE_M and beside < 0.5 * max(exit_.width_m, other.width_m)
    return behind or float(np.linalg.norm(offset)) < SAME_M


def _is_looked_at(track: _Track, state: DroneState) -> bool:
    """Whether the current view of an opening is valid: in range, in the field of view, not at a grazing angle."""
    offset = track.centre_w - state.p_w[:2]
    away = float(np.linalg.norm(offset))
    bearing = state.turn_to_rad(math.atan2(offset[1], offset[0]))
    squarely = abs(float(offset @ track.normal_w)) > _SQUARELY_COS * away
    return _NEAREST_M < away < FARTHEST_M and abs(bearing) < FIELD_RAD and squarely


def _leads_through(track: _Track, from_w: FloatArray, to_w: FloatArray) -> bool:
    """Whether the segment from ``(2,)`` to ``(2,)`` crosses an opening."""
    normal, centre = track.normal_w, track.centre_w
    before, behind = float((from_w - centre) @ normal), float((to_w - centre) @ normal)
    if before * behind >= 0.0 or np.linalg.norm(to_w - from_w) > _STEP_M:
        return False
    crossing = from_w + before / (before - behind) * (to_w - from_w) - centre
    return abs(float(crossing @ np.array([-normal[1], normal[0]]))) < 0.5 * track.width_m
