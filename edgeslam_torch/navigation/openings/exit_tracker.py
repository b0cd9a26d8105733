"""Tracking of exits over a flight: a detection is confirmed by detections from other viewpoints."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.navigation.openings.aperture_hypotheses import NEAR_M, aperture_hypotheses
from edgeslam_torch.navigation.openings.detour import has_detour
from edgeslam_torch.navigation.openings.exits import WIDEST_M, Gap, distinct, openings
from edgeslam_torch.navigation.openings.wall_frame import Walls, along_walls
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.types import FloatArray

_EVERY_S = 0.5
_SAME_M, _SAME_RAD = 0.5, math.radians(35.0)
"""Distance and angle within which detections belong to the same opening."""
_PASSAGE_M = 1.0
"""Minimum distance between two doors along a passage."""
PLACES_M = 0.5
"""Minimum distance between distinct viewpoints."""
FIELD_RAD = math.radians(20.0)
"""Half the field of view less a margin; an opening inside it that is not detected counts as missed."""
_SQUARELY_COS = math.cos(math.radians(50.0))
"""Maximum angle to an opening's normal for a valid view."""
_NEAREST_M, FARTHEST_M = 0.8, 2.5
"""Range of valid views: closer, an opening exceeds the field of view; farther, depth errors open and close it."""
_LOOKS = 3
"""Detections that an exit needs."""
_SHOWN = 2
"""Frontal detections that an exit needs; a single one may be accidental."""
_STEP_M = 1.0
"""Maximum distance between updates for which the crossing of an opening is detected."""
_HYPOTHESIS_LOOKS = 2
"""Detections that make a candidate: as many as a drone gets while passing a door."""
_GONE = 8
"""Consecutive misses, as many as a second look takes, after which an opening is no longer reported until it is detected
again. Later views rest on a better map, so they outweigh any number of earlier detections."""
_WAY_ROUND = 20
"""Consecutive updates (ten seconds) with a detour that override earlier ones without."""
_CELL_SIGMAS = 1.0 / math.sqrt(6.0)
"""Standard deviation of a width between two cells [cells]: both ends are uniform within their cells."""


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
    """An unconfirmed opening: detected from one viewpoint only, or an aperture hypothesis."""

    centre_w: FloatArray
    """``(2,)`` [m]."""
    normal_w: FloatArray
    """``(2,)`` unit normal."""
    place_w: FloatArray
    """``(2,)`` first viewpoint [m]."""
    elsewhere: bool = True
    """Whether it needs another viewpoint; an aperture hypothesis does not."""


@dataclass(slots=True)
class _Seen:
    """Detections of one opening."""

    centres: Places = field(default_factory=Places)
    """Of each detection, tied to the view that it was detected in: a misplaced submap may overlap it in space."""
    tips: Places = field(default_factory=Places)
    """A width behind each centre: with it, width and normal follow the map, too."""
    places: Places = field(default_factory=Places)
    """Viewpoints."""
    near: int = 0
    shown: int = 0
    """Valid views (`_is_looked_at`) with a detection ..."""
    missed: int = 0
    """... and without one."""
    gone: int = 0
    """Misses since the last detection."""
    parting: int = 0
    """Close views without a detour less those with one; the majority decides."""
    round: int = 0
    """Consecutive close views with a detour, up to the last."""
    flown: bool = False
    """Whether the drone has flown through it, which proves that it is open."""

    def add(self, views: MapViews, gap: Gap) -> None:
        """Add a detection in the newest view."""
        self.centres.add(views, gap.centre_w)
        self.tips.add(views, gap.centre_w + gap.width_m * gap.normal_w)

    @property
    def centre_w(self) -> FloatArray:
        return np.asarray(np.median(self.centres.p_w, axis=0))

    @property
    def widths_m(self) -> FloatArray:
        """``(N,)`` of each detection."""
        return np.asarray(np.linalg.norm(self.tips.p_w - self.centres.p_w, axis=1))

    @property
    def normals_w(self) -> FloatArray:
        """``(N, 2)`` of each detection; the sign depends on the side of the drone."""
        return (self.tips.p_w - self.centres.p_w) / self.widths_m[:, None]

    @property
    def normal_w(self) -> FloatArray:
        """``(2,)`` away from the first viewpoint."""
        return np.asarray(self.normals_w[0])

    @property
    def is_shown(self) -> bool:
        """Whether enough valid views detect it and few miss it."""
        return self.shown >= _SHOWN and self.missed < self.shown + _LOOKS

    def note_way_round(self, known: bool) -> None:
        """Count a detour test; `_WAY_ROUND` consecutive detours override earlier results, which had less map."""
        self.round = self.round + 1 if known else 0
        self.parting = self.parting + (-1 if known else 1)
        if self.round >= _WAY_ROUND:
            self.parting = min(self.parting, -self.round)


@dataclass(slots=True)
class ExitTracker:
    """Detects and tracks exits during a flight."""

    exits: tuple[Exit, ...] = ()
    """Confirmed exits, the nearest first; replaced as a whole, so that other threads may read it."""
    candidates: tuple[Candidate, ...] = ()
    """Unconfirmed openings."""
    _seen: list[_Seen] = field(default_factory=list)
    _hypotheses: list[_Seen] = field(default_factory=list)
    _looked_s: float = -math.inf
    _looked_w: FloatArray | None = None
    """``(2,)`` position at the last update."""

    def due(self, state: DroneState) -> bool:
        """Whether it is time for an update. Views in a submap whose position is too uncertain do not count."""
        placed = state.metric and state.tracked and state.submap_sigma_m <= DEAD_RECKONING_SIGMA_M
        return placed and state.view is not None and state.stamp_s - self._looked_s >= _EVERY_S

    def look(self, walls: Walls, state: DroneState) -> None:
        """Update with detections in the current grid; only those within `NEAR_M` count."""
        self._looked_s = state.stamp_s
        here = state.p_w[:2]
        grids = along_walls(walls, here)
        found = openings(grids)
        partly = distinct(found)
        self._count(distinct([gap for gap in found if gap.is_free]), partly, state)
        for seen in self._seen:
            seen.flown |= self._looked_w is not None and _leads_through(seen, self._looked_w, here)
        self._looked_w = here.copy()
        hypotheses = aperture_hypotheses(grids, state.view, here) if state.view is not None else []
        for gap in distinct([*partly, *hypotheses]):
            _note(self._hypotheses, gap, state)
        often = [s for s in self._seen if s.near >= _LOOKS]
        open_ = [s for s in often if s.flown or s.gone <= _GONE]
        twice = [s for s in open_ if _places(s.places.p_w) >= 2]
        self.exits = self._exits([s for s in twice if s.flown or s.is_shown], walls.layer, state)
        unsure = [s for s in open_ if not s.flown and (s.shown <= max(s.missed, 1) or _places(s.places.p_w) < 2)]
        doubted = [(s, _places(s.places.p_w) < 2) for s in unsure]
        repeated = [s for s in self._hypotheses if s.near >= _HYPOTHESIS_LOOKS]
        doubted += [(s, False) for s in repeated if not any(_are_same(s, other) for other in often)]
        self.candidates = tuple(_candidate(*doubt) for doubt in doubted if not _parts_nothing(doubt[0], walls.layer))

    def _count(self, free: list[Gap], partly: list[Gap], state: DroneState) -> None:
        """Count detections and misses; openings without a valid view stay unchanged."""
        for seen in self._seen:
            if not _is_looked_at(seen, state):
                continue
            if any(_same(gap, seen) for gap in partly):
                seen.shown, seen.gone = seen.shown + 1, 0
            else:
                seen.missed, seen.gone = seen.missed + 1, seen.gone + 1
        for gap in free:
            _note(self._seen, gap, state)
        self._seen = [seen for seen in self._seen if seen.missed <= 2 * max(len(seen.centres), _LOOKS)]

    def _exits(self, good: list[_Seen], layer: Layer, state: DroneState) -> tuple[Exit, ...]:
        """Openings that separate two rooms, one per passage."""
        good.sort(key=lambda s: -s.near)
        measured = [(seen, e) for seen in good if (e := _exit(seen, state)).width_m <= WIDEST_M]
        for seen, exit_ in measured:
            if np.linalg.norm(exit_.centre_w[:2] - state.p_w[:2]) < NEAR_M:  # from afar walls have holes
                seen.note_way_round(_passed_by(exit_, layer))
        exits = [e for seen, e in measured if seen.parting > 0]
        single = [e for k, e in enumerate(exits) if not any(_one_passage(e, other) for other in exits[:k])]
        return tuple(sorted(single, key=lambda e: float(np.linalg.norm(e.centre_w[:2] - state.p_w[:2]))))

    def expire(self) -> None:
        """Make an update due, since the map was corrected; the way from the last one is no way that was flown."""
        self._looked_s, self._looked_w = -math.inf, None


def _note(among: list[_Seen], gap: Gap, state: DroneState) -> None:
    here_w = state.p_w[:2]
    seen = next((s for s in among if _same(gap, s)), None)
    if seen is None:
        seen = _Seen()
        among.append(seen)
    seen.add(state.views, gap)
    seen.gone = 0
    if np.linalg.norm(gap.centre_w - here_w) < NEAR_M:
        seen.near += 1
        seen.places.add(state.views, here_w)


def _candidate(seen: _Seen, elsewhere: bool) -> Candidate:
    return Candidate(seen.centre_w, seen.normal_w, seen.places.p_w[0], elsewhere)


def _parts_nothing(seen: _Seen, layer: Layer) -> bool:
    """Whether it is too wide or a gap within one room."""
    width_m = float(np.median(seen.widths_m))
    return width_m > WIDEST_M or has_detour(layer, seen.centre_w, seen.normal_w, width_m)


def _exit(seen: _Seen, state: DroneState) -> Exit:
    """Robust estimate of an opening from its detections."""
    centres, widths, normals = seen.centres.p_w, seen.widths_m, seen.normals_w
    turned = normals * np.sign(normals @ normals[0])[:, None]
    normal = np.sum(turned, axis=0) / np.linalg.norm(np.sum(turned, axis=0))
    cell = 0.1 * _CELL_SIGMAS
    centre, width = np.median(centres, axis=0), float(np.median(widths))
    away = float(np.linalg.norm(centre - state.p_w[:2]))
    spread = float(np.sqrt(0.5 * np.mean(((centres - centre) ** 2).sum(1))))
    position = math.hypot(cell, spread, state.position_sigma_m, state.scale_sigma * away)
    width_sigma = math.hypot(cell, float(np.std(widths)), state.scale_sigma * width)
    return Exit(np.array([*centre, state.p_w[2]]), np.array([*normal, 0.0]), width, width_sigma, position,
                _places(seen.places.p_w))  # fmt: skip


def _passed_by(exit_: Exit, layer: Layer) -> bool:
    """Whether it is a gap within one room."""
    return has_detour(layer, exit_.centre_w[:2], exit_.normal_w[:2], exit_.width_m)


def _one_passage(exit_: Exit, other: Exit) -> bool:
    """Whether two exits are the same opening detected along two wall directions, or a door and an obstacle in front of
    it: one behind the other, closer than two doors."""
    offset, normal = exit_.centre_w - other.centre_w, other.normal_w
    along = abs(float(offset @ normal))
    beside = math.sqrt(max(0.0, float(offset @ offset) - along**2))
    parallel = abs(float(exit_.normal_w @ normal)) > math.cos(_SAME_RAD)
    behind = parallel and along < _PASSAGE_M and beside < 0.5 * max(exit_.width_m, other.width_m)
    return behind or float(np.linalg.norm(offset)) < _SAME_M


def _same(gap: Gap, seen: _Seen) -> bool:
    """Whether a detection belongs to an opening; the sign of the normal depends on the side of the drone."""
    return _is_one(gap.centre_w, gap.normal_w, seen)


def _are_same(one: _Seen, other: _Seen) -> bool:
    """Whether the first detection of an opening belongs to another one."""
    return _is_one(one.centres.p_w[0], one.normal_w, other)


def _is_one(centre_w: FloatArray, normal_w: FloatArray, seen: _Seen) -> bool:
    turned = math.acos(min(1.0, abs(float(normal_w @ seen.normal_w))))
    return turned < _SAME_RAD and float(np.linalg.norm(centre_w - seen.centre_w)) < _SAME_M


def _is_looked_at(seen: _Seen, state: DroneState) -> bool:
    """Whether the current view of an opening is valid: in range, in the field of view, not at a grazing angle."""
    offset = seen.centre_w - state.p_w[:2]
    away = float(np.linalg.norm(offset))
    bearing = float(wrapped(np.array(math.atan2(offset[1], offset[0]) - state.yaw_rad)))
    squarely = abs(float(offset @ seen.normal_w)) > _SQUARELY_COS * away
    return _NEAREST_M < away < FARTHEST_M and abs(bearing) < FIELD_RAD and squarely


def _leads_through(seen: _Seen, from_w: FloatArray, to_w: FloatArray) -> bool:
    """Whether the segment from ``(2,)`` to ``(2,)`` crosses an opening."""
    normal, centre = seen.normal_w, seen.centre_w
    before, behind = float((from_w - centre) @ normal), float((to_w - centre) @ normal)
    if before * behind >= 0.0 or np.linalg.norm(to_w - from_w) > _STEP_M:
        return False
    crossing = from_w + before / (before - behind) * (to_w - from_w) - centre
    width_m = float(np.median(seen.widths_m))
    return abs(float(crossing @ np.array([-normal[1], normal[0]]))) < 0.5 * width_m


def _places(places_w: FloatArray) -> int:
    """Number of distinct viewpoints."""
    kept: list[FloatArray] = []
    for place in places_w:
        if all(np.linalg.norm(place - other) >= PLACES_M for other in kept):
            kept.append(place)
    return len(kept)
