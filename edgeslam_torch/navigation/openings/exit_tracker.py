"""Exits over a flight: what one look takes for an opening counts when looks from other places agree."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.aperture_hypotheses import NEAR_M, aperture_hypotheses
from edgeslam_torch.navigation.openings.detour import has_detour
from edgeslam_torch.navigation.openings.exits import WIDEST_M, Gap, distinct, openings
from edgeslam_torch.navigation.openings.wall_frame import Walls, along_walls
from edgeslam_torch.navigation.supervisor import DEAD_RECKONING_SIGMA_M
from edgeslam_torch.types import FloatArray

_EVERY_S = 0.5
_SAME_M, _SAME_RAD = 0.5, math.radians(35.0)
"""A look within these of an earlier one is of the same opening."""
_PASSAGE_M = 1.0
"""Distance along a passage within which it has one door."""
PLACES_M = 0.5
"""Distance between two places that count as two."""
FIELD_RAD = math.radians(20.0)
"""Half the camera's field of view, less a margin: an opening within it that is not found again counts against it."""
_SQUARELY_COS = math.cos(math.radians(50.0))
"""Angle to an opening's normal from which on it is seen aslant."""
_NEAREST_M, FARTHEST_M = 0.8, 2.5
"""From nearer an opening is more than what a camera sees; from farther away it closes and opens with every depth."""
_LOOKS = 3
_SHOWN = 2
"""Looks from before it that an exit needs: one is chance."""
_STEP_M = 1.0
"""Way from one look to the next in which it is known what the drone flew through."""
_HYPOTHESIS_LOOKS = 2
"""Looks that make a doubt: as many as a drone has that flies past a door."""
_GONE = 8
"""Looks at it, as long as a second look takes, that show nothing open there, one after the other: later ones know more
than earlier ones, so what fifty of them told before is not told until it is seen again."""
_WAY_ROUND = 20
"""Looks on end, ten seconds, in which a way leads round it."""
_CELL_SIGMAS = 1.0 / math.sqrt(6.0)
"""Standard deviation of a width between two cells, in cells: each end is anywhere in its own."""


@dataclass(frozen=True, slots=True)
class Exit:
    """An opening of a door's width in a wall, free on both sides, seen from at least two places."""

    centre_w: FloatArray
    """``(3,)`` its middle at the height of the drone, in the drone's world [m]."""
    normal_w: FloatArray
    """``(3,)`` level unit vector through it, away from where it was seen first."""
    width_m: float
    width_sigma_m: float
    position_sigma_m: float
    """Standard deviation of each level coordinate of the middle, relative to the drone's present place [m]."""
    places: int
    """From how many places it was seen."""

    def beyond(self, away_m: float) -> FloatArray:
        """The point ``(3,)`` behind it; before it with a negative distance."""
        return np.asarray(self.centre_w + away_m * self.normal_w)


@dataclass(frozen=True, slots=True)
class Candidate:
    """What looked like an opening, again and again, from one place only, or in a hypothesis."""

    centre_w: FloatArray
    """``(2,)`` [m]."""
    normal_w: FloatArray
    """``(2,)`` level unit vector through it."""
    place_w: FloatArray
    """``(2,)`` where it was seen from first [m]."""
    elsewhere: bool = True
    """Whether it must be looked at from another place than that: it was seen open from there, not in a hypothesis."""


@dataclass(slots=True)
class _Seen:
    """One opening, look by look."""

    gaps: list[Gap]
    pictures: list[int]
    """Number of the picture that each was seen in."""
    places_w: list[FloatArray]
    near: int = 0
    shown: int = 0
    """Looks at it (`_is_looked_at`) that show something open there ..."""
    missed: int = 0
    """... and those that do not."""
    gone: int = 0
    """Those missed since it was seen last."""
    parting: int = 0
    """Looks from near by in which no way led round it, less those in which one did: most of them decide."""
    round: int = 0
    """The last of these, on end, in which one did."""
    flown: bool = False
    """Whether the drone has flown through it: it is open, whatever looks show."""

    @property
    def centre_w(self) -> FloatArray:
        return np.asarray(np.median([g.centre_w for g in self.gaps], axis=0))

    @property
    def is_shown(self) -> bool:
        """Whether looks at it show it open, more than one, and few that do not."""
        return self.shown >= _SHOWN and self.missed < self.shown + _LOOKS

    def note_way_round(self, known: bool) -> None:
        """One more look: looks from when no way round it was known yet do not outvote ten seconds that know one."""
        self.round = self.round + 1 if known else 0
        self.parting = self.parting + (-1 if known else 1)
        if self.round >= _WAY_ROUND:
            self.parting = min(self.parting, -self.round)


@dataclass(slots=True)
class ExitTracker:
    """Looks for exits while a drone flies."""

    exits: tuple[Exit, ...] = ()
    """What counts as an exit now, the nearest first; replaced as a whole, so that other threads may read it."""
    candidates: tuple[Candidate, ...] = ()
    """What may be one, if it looks so from elsewhere, too."""
    _seen: list[_Seen] = field(default_factory=list)
    _hypotheses: list[_Seen] = field(default_factory=list)
    _looked_s: float = -math.inf
    _looked_w: FloatArray | None = None
    """``(2,)`` from where it looked last."""

    def due(self, state: DroneState) -> bool:
        """Whether it is time for another look. In a piece of map that may lie half a hull elsewhere none counts, for or
        against what was found."""
        placed = state.metric and state.tracked and state.submap_sigma_m <= DEAD_RECKONING_SIGMA_M
        return placed and state.view is not None and state.stamp_s - self._looked_s >= _EVERY_S

    def look(self, walls: Walls, state: DroneState) -> None:
        """Compare what the grid shows now with what it showed before; from farther away than `NEAR_M` none counts."""
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
        twice = [s for s in open_ if _places(s.places_w) >= 2]
        self.exits = self._exits([s for s in twice if s.flown or s.is_shown], walls.layer, state)
        unsure = [s for s in open_ if not s.flown and (s.shown <= max(s.missed, 1) or _places(s.places_w) < 2)]
        doubted = [(s, _places(s.places_w) < 2) for s in unsure]
        repeated = [s for s in self._hypotheses if s.near >= _HYPOTHESIS_LOOKS]
        doubted += [(s, False) for s in repeated if not any(_same(s.gaps[0], other) for other in often)]
        self.candidates = tuple(_candidate(*doubt) for doubt in doubted if not _parts_nothing(doubt[0], walls.layer))

    def _count(self, free: list[Gap], partly: list[Gap], state: DroneState) -> None:
        """What speaks for and against what was seen before: what is not looked at stays as it was."""
        for seen in self._seen:
            if not _is_looked_at(seen, state):
                continue
            if any(_same(gap, seen) for gap in partly):
                seen.shown, seen.gone = seen.shown + 1, 0
            else:
                seen.missed, seen.gone = seen.missed + 1, seen.gone + 1
        for gap in free:
            _note(self._seen, gap, state)
        self._seen = [seen for seen in self._seen if seen.missed <= 2 * max(len(seen.gaps), _LOOKS)]

    def _exits(self, good: list[_Seen], layer: Layer, state: DroneState) -> tuple[Exit, ...]:
        """Those that part two rooms, one of each passage."""
        good.sort(key=lambda s: -s.near)
        told = [(seen, e) for seen in good if (e := _exit(seen, state)).width_m <= WIDEST_M]
        for seen, exit_ in told:
            if np.linalg.norm(exit_.centre_w[:2] - state.p_w[:2]) < NEAR_M:  # from afar a wall gets holes
                seen.note_way_round(_passed_by(exit_, layer))
        exits = [e for seen, e in told if seen.parting > 0]
        single = [e for k, e in enumerate(exits) if not any(_one_passage(e, other) for other in exits[:k])]
        return tuple(sorted(single, key=lambda e: float(np.linalg.norm(e.centre_w[:2] - state.p_w[:2]))))

    def carry(self, update: MapUpdate) -> None:
        """Take what was found along with the map; `exits` are those of the next look."""
        for seen in [*self._seen, *self._hypotheses]:
            centres = update.points(np.array([gap.centre_w for gap in seen.gaps]), seen.pictures)
            beyond = update.points(np.array([gap.centre_w + 0.1 * gap.normal_w for gap in seen.gaps]), seen.pictures)
            seen.gaps = [_carried(*gap, update.ratio) for gap in zip(seen.gaps, centres, beyond, strict=True)]
            seen.places_w = list(update.points(np.array(seen.places_w).reshape(-1, 2)))
        self._looked_w = None


def _note(among: list[_Seen], gap: Gap, state: DroneState) -> None:
    here_w = state.p_w[:2]
    seen = next((s for s in among if _same(gap, s)), None)
    if seen is None:
        seen = _Seen([], [], [])
        among.append(seen)
    seen.gaps.append(gap)
    seen.pictures.append(-1 if state.view is None else state.view.picture)
    seen.gone = 0
    if np.linalg.norm(gap.centre_w - here_w) < NEAR_M:
        seen.near += 1
        seen.places_w.append(here_w.copy())


def _candidate(seen: _Seen, elsewhere: bool) -> Candidate:
    return Candidate(seen.centre_w, seen.gaps[0].normal_w, seen.places_w[0], elsewhere)


def _parts_nothing(seen: _Seen, layer: Layer) -> bool:
    """Whether it is too wide, or the space between two things in one room."""
    width_m = float(np.median([gap.width_m for gap in seen.gaps]))
    return width_m > WIDEST_M or has_detour(layer, seen.centre_w, seen.gaps[0].normal_w, width_m)


def _exit(seen: _Seen, state: DroneState) -> Exit:
    """The opening as the looks agree on it."""
    centres, widths = np.array([g.centre_w for g in seen.gaps]), np.array([g.width_m for g in seen.gaps])
    first = seen.gaps[0].normal_w
    turned = [g.normal_w * np.sign(g.normal_w @ first) for g in seen.gaps]
    normal = np.sum(turned, axis=0) / np.linalg.norm(np.sum(turned, axis=0))
    cell = 0.1 * _CELL_SIGMAS
    centre, width = np.median(centres, axis=0), float(np.median(widths))
    away = float(np.linalg.norm(centre - state.p_w[:2]))
    spread = float(np.sqrt(0.5 * np.mean(((centres - centre) ** 2).sum(1))))
    position = math.hypot(cell, spread, state.position_sigma_m, state.scale_sigma * away)
    width_sigma = math.hypot(cell, float(np.std(widths)), state.scale_sigma * width)
    return Exit(np.array([*centre, state.p_w[2]]), np.array([*normal, 0.0]), width, width_sigma, position,
                _places(seen.places_w))  # fmt: skip


def _passed_by(exit_: Exit, layer: Layer) -> bool:
    """Whether it is the space between two things in one room."""
    return has_detour(layer, exit_.centre_w[:2], exit_.normal_w[:2], exit_.width_m)


def _one_passage(exit_: Exit, other: Exit) -> bool:
    """Whether both are one opening, seen along two directions, or lie one behind the other, nearer than two doors do: a
    door, and something that stands before it."""
    offset, normal = exit_.centre_w - other.centre_w, other.normal_w
    along = abs(float(offset @ normal))
    beside = math.sqrt(max(0.0, float(offset @ offset) - along**2))
    alike = abs(float(exit_.normal_w @ normal)) > math.cos(_SAME_RAD)
    behind = alike and along < _PASSAGE_M and beside < 0.5 * max(exit_.width_m, other.width_m)
    return behind or float(np.linalg.norm(offset)) < _SAME_M


def _carried(gap: Gap, centre_w: FloatArray, beyond_w: FloatArray, ratio: float) -> Gap:
    """The same opening after its middle and a point behind it moved."""
    normal = (beyond_w - centre_w) / np.linalg.norm(beyond_w - centre_w)
    return replace(gap, centre_w=centre_w, normal_w=normal, width_m=ratio * gap.width_m)


def _same(gap: Gap, seen: _Seen) -> bool:
    """The normal may point either way: the drone may have flown through."""
    turned = math.acos(min(1.0, abs(float(gap.normal_w @ seen.gaps[0].normal_w)))) if seen.gaps else 0.0
    return turned < _SAME_RAD and float(np.linalg.norm(gap.centre_w - seen.centre_w)) < _SAME_M


def _is_looked_at(seen: _Seen, state: DroneState) -> bool:
    """Whether a camera has an opening before it, and not aslant: along a wall it sees nothing of a door."""
    offset = seen.centre_w - state.p_w[:2]
    away = float(np.linalg.norm(offset))
    bearing = float(wrapped(np.array(math.atan2(offset[1], offset[0]) - state.yaw_rad)))
    squarely = abs(float(offset @ seen.gaps[0].normal_w)) > _SQUARELY_COS * away
    return _NEAREST_M < away < FARTHEST_M and abs(bearing) < FIELD_RAD and squarely


def _leads_through(seen: _Seen, from_w: FloatArray, to_w: FloatArray) -> bool:
    """Whether a short straight way ``(2,)`` to ``(2,)`` leads through an opening."""
    normal, centre = seen.gaps[0].normal_w, seen.centre_w
    before, behind = float((from_w - centre) @ normal), float((to_w - centre) @ normal)
    if before * behind >= 0.0 or np.linalg.norm(to_w - from_w) > _STEP_M:
        return False
    crossing = from_w + before / (before - behind) * (to_w - from_w) - centre
    width_m = float(np.median([gap.width_m for gap in seen.gaps]))
    return abs(float(crossing @ np.array([-normal[1], normal[0]]))) < 0.5 * width_m


def _places(places_w: list[FloatArray]) -> int:
    """How many of the places lie apart from each other."""
    kept: list[FloatArray] = []
    for place in places_w:
        if all(np.linalg.norm(place - other) >= PLACES_M for other in kept):
            kept.append(place)
    return len(kept)
