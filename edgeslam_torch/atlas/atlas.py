"""The submaps, and the search for links that merge two of them or close a loop in one.

A false merge corrupts the whole map; a missed one leaves two submaps. Hence a merge or a loop needs two links without a
common keyframe that agree about the similarity.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.atlas.links import Link, link, on_one_plane
from edgeslam_torch.atlas.loops import (
    LOOP_SHARE,
    Bridge,
    Closure,
    as_it_is,
    bridge,
    expected_drift,
    far_keyframes,
    is_near_prediction,
    is_plausible,
    is_within_reach,
    spread,
)
from edgeslam_torch.atlas.map_merging import look_around, merge_submaps, move_piece, share_anchors
from edgeslam_torch.atlas.place_recognition import MIN_VOTES, revisit_candidates
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.atlas.submap_heading import Facing, Turned, angle_between, is_turned, turn_about
from edgeslam_torch.atlas.submap_scale import AGAIN_S as UNIT_AGAIN_S
from edgeslam_torch.atlas.submap_scale import Rescaled, about, is_other
from edgeslam_torch.geometry import sim3
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.tracking.tracker import Tracker
from edgeslam_torch.types import FloatArray, ScaleEstimate

MAX_CANDIDATES = 3
"""Maximum number of keyframes of other submaps that a new keyframe is matched with."""
AGREEING_LINKS = 2
MIN_BASELINE = 0.02
"""Distance between the keyframes of two links, relative to their depth, from which on they are independent."""
MIN_TURN_RAD = np.deg2rad(3.0)
"""Rotation between them from which on they are independent."""
LOOP_SEARCH_S = 1.0
"""Time between two searches for loops; each costs half a frame."""
LOOP_SEARCH_RAD = np.deg2rad(20.0)
"""Rotation after which a search is due at once: a third of the view is new."""
LOOP_VOTES = 20
"""Votes for a candidate to be matched: a tenth of `MOST_VOTERS`. True revisits get 30 and more of 200, repetitive
wallpaper 22."""
AGAIN_S = 0.1
"""Time between two keyframes of a renewed search, which takes a third of a core."""
WITNESSES = 4
"""Covisible keyframes that are matched to confirm a new link."""


@dataclass(frozen=True, slots=True)
class Join:
    """A merge of two submaps."""

    stamp_s: float
    """Stamp of the confirming keyframe."""
    piece: int
    """Number of the merged submap."""
    absorbed: int
    """Number that no longer exists."""
    moved: int
    """Submap that was transformed to the other."""
    S: FloatArray
    """``(4, 4)`` similarity that transformed it."""
    sigma_log: float
    """Standard deviation of its log scale: measurement, difference between links, and bending of the maps."""
    links: int
    """Number of keyframes that agreed."""
    matches: int
    """Number of their matched keypoints."""
    scale_change: dict[int, float] = field(default_factory=dict)
    """Change of scale at each keyframe by the subsequent correction of the older submap's drift."""

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Change of scale at a keyframe of a submap."""
        return (sim3.scale_of(self.S) if self.moved == piece else 1.0) * self.scale_change.get(keyframe_id, 1.0)

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        scale = sim3.scale_of(self.S)
        return (
            f"piece {self.absorbed} joined piece {self.piece}: {self.links} keyframes agree, {self.matches} keypoints, "
            f"piece {self.moved} scaled by {scale:.3f} (sigma {100 * self.sigma_log:.1f} %)"
        )


class Atlas:
    """Matches every new keyframe with other submaps, and with distant parts of its own.

    Args:
        tracker: Contains the map.
        edges: Measured edges, which move with their keyframes.
        log: Frames, which move with their keyframes.
        lm: Settings of the refinement.
        closing: Whether to close loops inside a submap.
        metres: Metres per map unit around the stamp of an earlier frame, by sensors other than the camera.
        metres_along: The same for some frames, by their stamps ``(F,)`` and poses ``(F, 4, 4)``.
        start_sigma: Standard deviation per axis [map units] of the start of a submap, by its number, if the drone's
            sensors predicted it; infinite otherwise.
        facing_along: Orientation of the map of some frames, by their stamps ``(F,)`` and poses ``(F, 4, 4)``, in the
            drone's world, by its attitude.
    """

    def __init__(
        self,
        tracker: Tracker,
        edges: EdgeMap,
        log: TrajectoryLog,
        lm: LmConfig,
        closing: bool = False,
        metres: Callable[[float], ScaleEstimate | None] = lambda _: None,
        metres_along: Callable[[FloatArray, FloatArray], ScaleEstimate | None] = lambda *_: None,
        start_sigma: Callable[[int], float] = lambda _: np.inf,
        facing_along: Callable[[FloatArray, FloatArray], Facing | None] = lambda *_: None,
    ) -> None:
        self.tracker = tracker
        self.map = tracker.map
        self.edges = edges
        self.log = log
        self.lm = lm
        self.closing = closing
        self.metres = metres
        self.metres_along = metres_along
        self.start_sigma = start_sigma
        self.facing_along = facing_along
        self.joins: list[Join] = []
        self.closures: list[Closure] = []
        self.known_scale: dict[int, ScaleEstimate] = {}
        """Metres per map unit of submaps of earlier flights, by their number."""
        self._links: list[Link] = []
        """Links between submaps that are not merged yet."""
        self._searched = -1
        """Newest keyframe that was searched."""
        self._again: list[int] = []
        """Keyframes to search once more, the next one last."""
        self._again_s = -np.inf
        """Stamp of the last renewed search."""
        self._loop_searched: Keyframe | None = None
        """Newest keyframe that was searched for a loop."""
        self._aligned_s = -np.inf
        """Stamp of the last comparison of the camera's submap with the flight's first one."""

    def others(self, piece: int) -> list[Keyframe]:
        """Keyframes of other submaps that have anchors."""
        return [k for k in self.map.keyframes.values() if self.map.piece_of(k.id) != piece and _is_mapped(k)]

    @property
    def is_divided(self) -> bool:
        """Whether there are several submaps."""
        return len({self.map.piece_of(id) for id in self.map.keyframes}) > 1

    @property
    def is_up_to_date(self) -> bool:
        """Whether every keyframe was searched and none is waiting for a renewed search."""
        return max(self.map.keyframes, default=-1) <= self._searched and not self._again

    def update(self, stamp_s: float = np.inf) -> Join | Closure | None:
        """Search the keyframes that are new since the last call, and one of those that wait for a renewed search.

        The caller must own the map.

        Args:
            stamp_s: Present time.

        Returns:
            The resulting merge or closed loop, if any.
        """
        for id in [*sorted(id for id in self.map.keyframes if id > self._searched), *self._next_again(stamp_s)]:
            self._searched = max(self._searched, id)
            change = self._search(self.map.keyframes[id])
            if change is not None:
                return change
        return None

    def search_again(self) -> None:
        """Search every keyframe once more in the next calls of `update`, newest first, after its submap has grown."""
        self._again = sorted(self.map.keyframes)

    def _next_again(self, stamp_s: float) -> list[int]:
        """The next keyframe of the renewed search, if one is due."""
        if not self._again or stamp_s - self._again_s < AGAIN_S:
            return []
        self._again_s = stamp_s
        id = self._again.pop()
        return [id] if id in self.map.keyframes else []

    def search_all_again(self) -> None:
        """Search every keyframe in the next `update`."""
        self._searched = -1
        self._loop_searched = None

    def _search(self, keyframe: Keyframe) -> Join | Closure | None:
        if not _is_mapped(keyframe):
            return None
        others = self.others(self.map.piece_of(keyframe.id))
        for candidate in [*self._candidates(keyframe, others, MAX_CANDIDATES), *self._loop_candidates(keyframe)]:
            found = self._link(keyframe, candidate)
            if found is not None:
                return self._settle(found)
        return None

    def _loop_candidates(self, keyframe: Keyframe) -> list[Keyframe]:
        """Revisit candidates far along the trajectory, if a search for loops is due."""
        last = self._loop_searched
        waits = (
            last is not None
            and keyframe.stamp_s - last.stamp_s < LOOP_SEARCH_S
            and _turn_rad(keyframe, last) < LOOP_SEARCH_RAD
        )
        if not self.closing or waits:
            return []
        self._loop_searched = keyframe
        return self._candidates(keyframe, far_keyframes(self.map, keyframe), MAX_CANDIDATES, LOOP_VOTES)

    def _candidates(
        self, keyframe: Keyframe, among: list[Keyframe], most: int, min_votes: int = MIN_VOTES
    ) -> list[Keyframe]:
        return revisit_candidates(self.map, keyframe.words, among, most, min_votes) if among else []

    def _link(self, keyframe: Keyframe, other: Keyframe) -> Link | None:
        """A verified link; within a submap, similar places too far apart are rejected."""
        if self.map.piece_of(keyframe.id) != self.map.piece_of(other.id):
            found = link(self.tracker, keyframe, other, scale_between=self._scale_between)
            return found if found is not None and self._may_lie_so(found) else None
        found = link(self.tracker, keyframe, other, LOOP_SHARE, scale_between=as_it_is)
        if found is None or (not found.by_images and self._is_flat(found)):
            return None
        expected = expected_drift(*(self.metres(k.stamp_s) for k in (keyframe, other)))
        metric = self._scale_of(self.map.piece_of(keyframe.id)) is not None
        return found if is_plausible(self.map, found, expected, metric) else None

    def _may_lie_so(self, one: Link) -> bool:
        """Whether a link between two submaps agrees with the sensors' prediction of their relative pose."""
        earlier = BEFORE_S in (one.keyframe.stamp_s, one.other.stamp_s)
        sigma = np.inf if earlier else self.start_sigma(max(self._pieces(one)))
        return is_near_prediction(self.map, one, sigma) if np.isfinite(sigma) else one.by_images

    def _is_flat(self, one: Link) -> bool:
        """Whether the anchors of a link lie on one plane, such as a wall with repetitive wallpaper."""
        return on_one_plane(self.map.anchors.p_w[one.anchor], one.depth)

    def align(self, stamp_s: float, now: tuple[float, float] | None = None) -> Rescaled | Turned | None:
        """Rotate or scale the camera's submap to the flight's first one if the drone's sensors show a difference.

        The caller must own the map.

        Args:
            stamp_s: Present time.
            now: Scale of the first submap relative to the camera's by present sensor data, if it differs
                significantly, and the standard deviation of its logarithm.
        """
        records = self.log.records
        if not records or stamp_s - self._aligned_s < UNIT_AGAIN_S:
            return None
        first, piece = (self.map.piece_of(records[k].keyframe_id) for k in (0, -1))
        if piece == first or piece in self.known_scale:
            return None
        self._aligned_s = stamp_s
        change = self._rotated(stamp_s, piece, first) or self._rescaled(stamp_s, piece, first, now)
        if change is not None:
            move_piece(self.map, self.edges, self.log, piece, change.S)
            self._links = []  # their similarities refer to the submaps before the change
        return change

    def _rotated(self, stamp_s: float, piece: int, first: int) -> Turned | None:
        mine, other = (self.facing_along(*self._frames_of(p)) for p in (piece, first))
        if mine is None or other is None:
            return None
        angle, sigma = angle_between(mine, other)
        if not is_turned(angle, sigma):
            return None
        return Turned(stamp_s, piece, turn_about(self._began(piece), mine[0], angle), angle, sigma)

    def _rescaled(self, stamp_s: float, piece: int, first: int, now: tuple[float, float] | None) -> Rescaled | None:
        for ratio in (self._relative_scale(piece, first), now):  # velocities along all of it; heights only at present
            if ratio is not None and is_other(*ratio):
                return Rescaled(stamp_s, piece, about(self._began(piece), ratio[0]), ratio[1])
        return None

    def _began(self, piece: int) -> FloatArray:
        """Start of a submap ``(3,)``."""
        return self.map.keyframes[min(id for id in self.map.keyframes if self.map.piece_of(id) == piece)].centre_w

    def _scale_between(self, keyframe: Keyframe, other: Keyframe) -> tuple[float, float] | None:
        return self._relative_scale(*(self.map.piece_of(k.id) for k in (keyframe, other)))

    def _relative_scale(self, piece: int, other: int) -> tuple[float, float] | None:
        """Scale of another submap relative to a submap, from metres along the frames of either."""
        here, there = self._scale_of(piece), self._scale_of(other)
        if here is None or there is None:
            return None
        sigma = float(np.hypot(here.sigma / here.value, there.sigma / there.value))
        return here.value / there.value, sigma

    def _scale_of(self, piece: int) -> ScaleEstimate | None:
        return self.metres_along(*self._frames_of(piece))

    def _frames_of(self, piece: int) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and poses ``(F, 4, 4)`` of the frames that a submap supports."""
        support = self.log.support()
        use = (support.piece == piece) & support.supported
        stamps_s, T_w_c = self.log.poses()
        return stamps_s[use], T_w_c[use]

    def _settle(self, found: Link) -> Join | Closure | None:
        """Apply a link if another one confirms it; covisible keyframes are searched for that."""
        agreeing = [found]
        for witness in self._witnesses(found):
            if witness.agrees(found) and all(_are_independent(witness, other) for other in agreeing):
                agreeing.append(witness)
        self._links.append(found)
        if len(agreeing) < AGREEING_LINKS:
            return None
        mine, theirs = self._pieces(found)
        return self._close(agreeing) if mine == theirs else self._join(agreeing)

    def _witnesses(self, found: Link) -> list[Link]:
        """Links between the same two submaps: earlier ones, and new ones of covisible keyframes."""
        pieces = self._pieces(found)
        known = [one for one in self._links if self._is_valid(one) and self._pieces(one) == pieces]
        new = []
        for keyframe in self.map.covisible(found.keyframe, WITNESSES):
            for candidate in self._candidates(keyframe, self._candidates_near(keyframe, found), 1):
                new.append(self._link(keyframe, candidate))
        return [*known, *(one for one in new if one is not None)]

    def _candidates_near(self, witness: Keyframe, found: Link) -> list[Keyframe]:
        """Keyframes that a covisible keyframe of a link may see as well."""
        mine, theirs = self._pieces(found)
        others = far_keyframes(self.map, witness) if mine == theirs else self.others(mine)
        return [k for k in others if self.map.piece_of(k.id) == theirs and k is not found.other]

    def _pieces(self, one: Link) -> tuple[int, int]:
        return self.map.piece_of(one.keyframe.id), self.map.piece_of(one.other.id)

    def _is_valid(self, one: Link) -> bool:
        """Whether both ends of a link are still in the map."""
        return all(self.map.keyframes.get(k.id) is k for k in (one.keyframe, one.other))

    def _close(self, links: list[Link]) -> Closure | None:
        """Close a loop; None if the offset is small, so that sharing anchors suffices."""
        self._links = []
        if all(is_within_reach(self.map, self.tracker.camera, one) for one in links):
            with self.map.lock:
                share_anchors(self.map, links)
            return None
        with self.map.lock:  # a consistent snapshot for readers
            closure = spread(self.map, self.edges, self.log, links)
            share_anchors(self.map, links)
            look_around(self.map, self.tracker.camera, links)  # later windows and the final refinement do the rest
        self.closures.append(closure)
        return closure

    def _join(self, links: list[Link]) -> Join:
        best = max(links, key=lambda one: len(one.keypoint))
        mine, theirs = self._pieces(best)
        sensed = bridge(self.map, mine, theirs) if np.isfinite(self.start_sigma(max(mine, theirs))) else None
        moved, S = mine, best.S
        if self._weight(mine) > self._weight(theirs):  # the smaller one moves
            moved, S = theirs, sim3.inverse(best.S)
        move_piece(self.map, self.edges, self.log, moved, S)
        made_up = None
        if sensed is not None:
            left = [replace(one, S=S @ one.S if moved == theirs else one.S @ sim3.inverse(S)) for one in links]
            made_up = self._make_up(left, sensed.scaled(sim3.scale_of(S)) if moved == min(mine, theirs) else sensed)
        merge_submaps(self.map, self.tracker.camera, links, self.lm)
        join = Join(
            max(one.keyframe.stamp_s for one in links),
            min(mine, theirs),
            max(mine, theirs),
            moved,
            S,
            _sigma_log(best, links),
            len(links),
            sum(len(one.keypoint) for one in links),
            {} if made_up is None else made_up.scale_change,
        )
        self.joins.append(join)
        self._follow_scale(mine, theirs, moved)
        self._again = []
        self._links = []  # their similarities refer to the submaps before the merge
        return join

    def _make_up(self, links: list[Link], sensed: Bridge) -> Closure:
        """Distribute the newer submap's correction over both: relative to the sensors' prediction it is the drift of
        the older one."""
        with self.map.lock:
            for one in links:
                self.map.join_pieces(one.keyframe, [one.other])
            return spread(self.map, self.edges, self.log, links, sensed)

    def _weight(self, piece: int) -> tuple[bool, int]:
        """Order by which a submap stays: metric scale from an earlier flight, then its size."""
        return piece in self.known_scale, sum(self.map.piece_of(id) == piece for id in self.map.keyframes)

    def _follow_scale(self, mine: int, theirs: int, moved: int) -> None:
        """The merged submap has the scale of the one that stayed."""
        scales = {piece: self.known_scale.pop(piece, None) for piece in (mine, theirs)}
        stayed = scales[mine if moved == theirs else theirs]
        if stayed is not None:
            self.known_scale[min(mine, theirs)] = stayed


def _sigma_log(best: Link, links: list[Link]) -> float:
    """Standard deviation of the log scale of the best of some agreeing links."""
    between = float(np.std([np.log(sim3.scale_of(one.S)) for one in links]))
    return float(np.sqrt(best.sigma_log**2 + best.bend_log**2 + between**2))


def _is_mapped(keyframe: Keyframe) -> bool:
    return bool((keyframe.anchor != NO_ANCHOR).any())


def _are_independent(one: Link, other: Link) -> bool:
    """Whether the keyframes of two links are independent observations."""
    there = MIN_BASELINE * one.depth
    here = there / sim3.scale_of(one.S)
    return _differ(one.keyframe, other.keyframe, here) and _differ(one.other, other.other, there)


def _differ(a: Keyframe, b: Keyframe, baseline: float) -> bool:
    """Whether two keyframes differ in position or direction."""
    return float(np.linalg.norm(a.centre_w - b.centre_w)) > baseline or _turn_rad(a, b) > MIN_TURN_RAD


def _turn_rad(a: Keyframe, b: Keyframe) -> float:
    """Angle between the viewing directions of two keyframes."""
    return float(np.arccos(np.clip(a.T_c_w[2, :3] @ b.T_c_w[2, :3], -1.0, 1.0)))
