"""The pieces of the map and the search for what joins them, or closes a loop in one of them.

One false join bends everything; a missed one leaves two pieces that say so. Hence two pieces are joined on two pairs of
keyframes that have no keyframe in common and agree about the similarity, never on one; and so is a loop closed.
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
    drift_told,
    far_keyframes,
    is_carried,
    is_plausible,
    is_within_reach,
    spread,
)
from edgeslam_torch.atlas.map_merging import look_around, move_piece, share_anchors, weld
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

CLOSER_LOOKS = 3
"""Keyframes of other pieces that a new keyframe is compared with."""
AGREEING_LINKS = 2
MIN_BASELINE = 0.02
"""Distance between the keyframes of two links, relative to their depth, from which on they are two witnesses."""
MIN_TURN_RAD = np.deg2rad(3.0)
"""Turn between them from which on they are, too."""
LOOK_BACK_S = 1.0
"""Time from one search for loops to the next: a loop may wait, and each search costs as much as half a frame."""
LOOK_BACK_RAD = np.deg2rad(20.0)
"""Turn after which it does not wait: a drone that turns on the spot has a third of a view before it that was not."""
LOOP_VOTES = 20
"""Votes from which on it is worth a closer look: a tenth. Where a fifth of what is in view will be found, 30 and more
of 200 keypoints vote; a wall with the same paper gets 22."""
AGAIN_S = 0.1
"""Time from one keyframe that is asked again to the next: a third of a core while that lasts."""
WITNESSES = 4
"""Earlier keyframes of the same piece that are asked at once when one has found a link."""


@dataclass(frozen=True, slots=True)
class Join:
    """Two pieces that were found to be one."""

    stamp_s: float
    """Of the keyframe that settled it."""
    piece: int
    """Number of the piece that is left."""
    absorbed: int
    """Number that no longer exists."""
    moved: int
    """Which of the two was moved to the other's place and size."""
    S: FloatArray
    """``(4, 4)`` similarity that moved it."""
    sigma_log: float
    """Standard deviation of its log scale: as measured, as the links differ, and as the maps bend where they meet."""
    links: int
    """Keyframes that agreed."""
    matches: int
    """Keypoints of these that show the other piece."""
    grown: dict[int, float] = field(default_factory=dict)
    """Factor by which the map grew around each keyframe after that, when the drift of the older piece was spread."""

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Factor by which the map grew around a keyframe that belonged to a piece."""
        return (sim3.scale_of(self.S) if self.moved == piece else 1.0) * self.grown.get(keyframe_id, 1.0)

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        scale = sim3.scale_of(self.S)
        return (
            f"piece {self.absorbed} joined piece {self.piece}: {self.links} keyframes agree, {self.matches} keypoints, "
            f"piece {self.moved} scaled by {scale:.3f} (sigma {100 * self.sigma_log:.1f} %)"
        )


class Atlas:
    """Asks every new keyframe whether it shows a piece that it does not belong to, or a far part of its own.

    Args:
        tracker: With the map.
        edges: Measured edges, which move with their keyframes.
        log: Frames, which do so, too.
        lm: Settings of the refinement.
        closing: Whether loops inside a piece are closed.
        metres: Metres per map unit around the stamp of an earlier frame, where anything else than the images tells it.
        metres_along: The same along some frames, by their stamps ``(F,)`` and poses ``(F, 4, 4)``.
        carried: Standard deviation per axis [map units] of where a piece, by its number, began, if the drone's sensors
            carried the camera there; infinite otherwise.
        facing_along: How the map of some frames, by their stamps ``(F,)`` and poses ``(F, 4, 4)``, is turned in the
            drone's world, if its attitude tells.
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
        carried: Callable[[int], float] = lambda _: np.inf,
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
        self.carried = carried
        self.facing_along = facing_along
        self.joins: list[Join] = []
        self.closures: list[Closure] = []
        self.known_scale: dict[int, ScaleEstimate] = {}
        """Metres per unit of pieces of earlier flights, by their number."""
        self._links: list[Link] = []
        """Found so far, between pieces that are still apart."""
        self._asked = -1
        """Newest keyframe that was asked."""
        self._again: list[int] = []
        """Keyframes that are to be asked again, the next one last."""
        self._again_s = -np.inf
        """Stamp at which the last of them was."""
        self._looked_back: Keyframe | None = None
        """The newest keyframe that was asked for a loop."""
        self._aligned_s = -np.inf
        """Stamp at which the camera's piece was last compared with the flight's first one."""

    def strangers(self, piece: int) -> list[Keyframe]:
        """Keyframes of other pieces that have something to be recognised by."""
        return [k for k in self.map.keyframes.values() if self.map.piece_of(k.id) != piece and _is_mapped(k)]

    @property
    def is_divided(self) -> bool:
        """Whether the keyframes belong to several pieces."""
        return len({self.map.piece_of(id) for id in self.map.keyframes}) > 1

    @property
    def is_up_to_date(self) -> bool:
        """Whether every keyframe was asked, and none is to be asked again."""
        return max(self.map.keyframes, default=-1) <= self._asked and not self._again

    def update(self, stamp_s: float = np.inf) -> Join | Closure | None:
        """Ask the keyframes that are new since the last call, and one of those that are to be asked again.

        The map must belong to the caller.

        Args:
            stamp_s: Present time.

        Returns:
            The join or the closed loop that follows, if one does.
        """
        for id in [*sorted(id for id in self.map.keyframes if id > self._asked), *self._next_again(stamp_s)]:
            self._asked = max(self._asked, id)
            change = self._ask(self.map.keyframes[id])
            if change is not None:
                return change
        return None

    def ask_again(self) -> None:
        """Let the next calls of `update` ask every keyframe once more, the newest first: its piece has grown since."""
        self._again = sorted(self.map.keyframes)

    def _next_again(self, stamp_s: float) -> list[int]:
        """The keyframe whose turn it is, if it is time."""
        if not self._again or stamp_s - self._again_s < AGAIN_S:
            return []
        self._again_s = stamp_s
        id = self._again.pop()
        return [id] if id in self.map.keyframes else []

    def ask_all_again(self) -> None:
        """Let the next `update` ask every keyframe."""
        self._asked = -1
        self._looked_back = None

    def _ask(self, keyframe: Keyframe) -> Join | Closure | None:
        if not _is_mapped(keyframe):
            return None
        strangers = self.strangers(self.map.piece_of(keyframe.id))
        for candidate in [*self._alike(keyframe, strangers, CLOSER_LOOKS), *self._seen_before(keyframe)]:
            found = self._link(keyframe, candidate)
            if found is not None:
                return self._settle(found)
        return None

    def _seen_before(self, keyframe: Keyframe) -> list[Keyframe]:
        """Keyframes at the far end of a loop that look like this one, if it is time to ask."""
        last = self._looked_back
        waits = (
            last is not None
            and keyframe.stamp_s - last.stamp_s < LOOK_BACK_S
            and _turn_rad(keyframe, last) < LOOK_BACK_RAD
        )
        if not self.closing or waits:
            return []
        self._looked_back = keyframe
        return self._alike(keyframe, far_keyframes(self.map, keyframe), CLOSER_LOOKS, LOOP_VOTES)

    def _alike(
        self, keyframe: Keyframe, among: list[Keyframe], most: int, min_votes: int = MIN_VOTES
    ) -> list[Keyframe]:
        return revisit_candidates(self.map, keyframe.words, among, most, min_votes) if among else []

    def _link(self, keyframe: Keyframe, other: Keyframe) -> Link | None:
        """A link that may be true: within a piece, places that look alike and are far apart are not one."""
        if self.map.piece_of(keyframe.id) != self.map.piece_of(other.id):
            found = link(self.tracker, keyframe, other, told=self._size_between)
            return found if found is not None and self._may_lie_so(found) else None
        found = link(self.tracker, keyframe, other, LOOP_SHARE, told=as_it_is)
        if found is None or (not found.by_images and self._is_flat(found)):
            return None
        told = drift_told(*(self.metres(k.stamp_s) for k in (keyframe, other)))
        held = self._metres_of(self.map.piece_of(keyframe.id)) is not None
        return found if is_plausible(self.map, found, told, held) else None

    def _may_lie_so(self, one: Link) -> bool:
        """Whether a link between two pieces agrees with what the drone's sensors say of where they lie."""
        earlier = BEFORE_S in (one.keyframe.stamp_s, one.other.stamp_s)
        sigma = np.inf if earlier else self.carried(max(self._pieces(one)))
        return is_carried(self.map, one, sigma) if np.isfinite(sigma) else one.by_images

    def _is_flat(self, one: Link) -> bool:
        """Whether what a link rests on is one plane, such as a wall whose paper looks the same a metre on."""
        return on_one_plane(self.map.anchors.p_w[one.anchor], one.depth)

    def align(self, stamp_s: float, now: tuple[float, float] | None = None) -> Rescaled | Turned | None:
        """Turn the camera's piece as the flight's first one is turned, or bring it to its unit, if the drone's sensors
        tell another.

        The map must belong to the caller.

        Args:
            stamp_s: Present time.
            now: Size of the first piece relative to the camera's as the drone flies, if that is surely another, and
                its standard deviation in the logarithm.
        """
        records = self.log.records
        if not records or stamp_s - self._aligned_s < UNIT_AGAIN_S:
            return None
        first, piece = (self.map.piece_of(records[k].keyframe_id) for k in (0, -1))
        if piece == first or piece in self.known_scale:
            return None
        self._aligned_s = stamp_s
        change = self._turned(stamp_s, piece, first) or self._rescaled(stamp_s, piece, first, now)
        if change is not None:
            move_piece(self.map, self.edges, self.log, piece, change.S)
            self._links = []  # their similarities hold for pieces as they were
        return change

    def _turned(self, stamp_s: float, piece: int, first: int) -> Turned | None:
        mine, other = (self.facing_along(*self._frames_of(p)) for p in (piece, first))
        if mine is None or other is None:
            return None
        angle, sigma = angle_between(mine, other)
        if not is_turned(angle, sigma):
            return None
        return Turned(stamp_s, piece, turn_about(self._began(piece), mine[0], angle), angle, sigma)

    def _rescaled(self, stamp_s: float, piece: int, first: int, now: tuple[float, float] | None) -> Rescaled | None:
        for told in (self._size_told(piece, first), now):  # velocities along all of it, and heights, too, lately
            if told is not None and is_other(*told):
                return Rescaled(stamp_s, piece, about(self._began(piece), told[0]), told[1])
        return None

    def _began(self, piece: int) -> FloatArray:
        """Where a piece began ``(3,)``."""
        return self.map.keyframes[min(id for id in self.map.keyframes if self.map.piece_of(id) == piece)].centre_w

    def _size_between(self, keyframe: Keyframe, other: Keyframe) -> tuple[float, float] | None:
        return self._size_told(*(self.map.piece_of(k.id) for k in (keyframe, other)))

    def _size_told(self, piece: int, other: int) -> tuple[float, float] | None:
        """Size of another piece relative to a piece, by the metres along the frames of either."""
        here, there = self._metres_of(piece), self._metres_of(other)
        if here is None or there is None:
            return None
        sigma = float(np.hypot(here.sigma / here.value, there.sigma / there.value))
        return here.value / there.value, sigma

    def _metres_of(self, piece: int) -> ScaleEstimate | None:
        return self.metres_along(*self._frames_of(piece))

    def _frames_of(self, piece: int) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and poses ``(F, 4, 4)`` of the frames that a piece supports."""
        support = self.log.support()
        use = (support.piece == piece) & support.supported
        stamps_s, T_w_c = self.log.poses()
        return stamps_s[use], T_w_c[use]

    def _settle(self, found: Link) -> Join | Closure | None:
        """Make one of what a link connects if another one agrees; earlier keyframes are asked for it."""
        agreeing = [found]
        for witness in self._witnesses(found):
            if witness.agrees(found) and all(_apart_enough(witness, other) for other in agreeing):
                agreeing.append(witness)
        self._links.append(found)
        if len(agreeing) < AGREEING_LINKS:
            return None
        mine, theirs = self._pieces(found)
        return self._close(agreeing) if mine == theirs else self._join(agreeing)

    def _witnesses(self, found: Link) -> list[Link]:
        """Links between the same two pieces: those found before, and those of keyframes nearby."""
        pieces = self._pieces(found)
        known = [one for one in self._links if self._stands(one) and self._pieces(one) == pieces]
        new = []
        for keyframe in self.map.covisible(found.keyframe, WITNESSES):
            for candidate in self._alike(keyframe, self._asked_by(keyframe, found), 1):
                new.append(self._link(keyframe, candidate))
        return [*known, *(one for one in new if one is not None)]

    def _asked_by(self, witness: Keyframe, found: Link) -> list[Keyframe]:
        """Keyframes that a neighbour of a link's keyframe may see as well."""
        mine, theirs = self._pieces(found)
        others = far_keyframes(self.map, witness) if mine == theirs else self.strangers(mine)
        return [k for k in others if self.map.piece_of(k.id) == theirs and k is not found.other]

    def _pieces(self, one: Link) -> tuple[int, int]:
        return self.map.piece_of(one.keyframe.id), self.map.piece_of(one.other.id)

    def _stands(self, one: Link) -> bool:
        """Whether both ends of a link are still in the map."""
        return all(self.map.keyframes.get(k.id) is k for k in (one.keyframe, one.other))

    def _close(self, links: list[Link]) -> Closure | None:
        """Close a loop; None if it is as good as closed, and both ends only get the same anchors."""
        self._links = []
        if all(is_within_reach(self.map, self.tracker.camera, one) for one in links):
            with self.map.lock:
                share_anchors(self.map, links)
            return None
        with self.map.lock:  # a consistent snapshot for readers
            closure = spread(self.map, self.edges, self.log, links)
            share_anchors(self.map, links)
            look_around(self.map, self.tracker.camera, links)  # the windows that follow, and the end, refine
        self.closures.append(closure)
        return closure

    def _join(self, links: list[Link]) -> Join:
        best = max(links, key=lambda one: len(one.keypoint))
        mine, theirs = self._pieces(best)
        carried = bridge(self.map, mine, theirs) if np.isfinite(self.carried(max(mine, theirs))) else None
        moved, S = mine, best.S
        if self._weight(mine) > self._weight(theirs):  # the lighter one moves
            moved, S = theirs, sim3.inverse(best.S)
        move_piece(self.map, self.edges, self.log, moved, S)
        made_up = None
        if carried is not None:
            left = [replace(one, S=S @ one.S if moved == theirs else one.S @ sim3.inverse(S)) for one in links]
            made_up = self._make_up(left, carried.scaled(sim3.scale_of(S)) if moved == min(mine, theirs) else carried)
        weld(self.map, self.tracker.camera, links, self.lm)
        join = Join(
            max(one.keyframe.stamp_s for one in links),
            min(mine, theirs),
            max(mine, theirs),
            moved,
            S,
            _sigma_log(best, links),
            len(links),
            sum(len(one.keypoint) for one in links),
            {} if made_up is None else made_up.grown,
        )
        self.joins.append(join)
        self._follow_scale(mine, theirs, moved)
        self._again = []
        self._links = []  # their similarities hold for pieces as they were
        return join

    def _make_up(self, links: list[Link], carried: Bridge) -> Closure:
        """Spread over both pieces how far the newer one has been moved from where the drone's sensors carried it to:
        that is what the older one has drifted by on its way, and left there it would pull the pieces apart again."""
        with self.map.lock:
            for one in links:
                self.map.join_pieces(one.keyframe, [one.other])
            return spread(self.map, self.edges, self.log, links, carried)

    def _weight(self, piece: int) -> tuple[bool, int]:
        """What speaks against moving a piece: metres known from an earlier flight, then its size."""
        return piece in self.known_scale, sum(self.map.piece_of(id) == piece for id in self.map.keyframes)

    def _follow_scale(self, mine: int, theirs: int, moved: int) -> None:
        """The joined piece has the units of the one that stayed."""
        scales = {piece: self.known_scale.pop(piece, None) for piece in (mine, theirs)}
        stayed = scales[mine if moved == theirs else theirs]
        if stayed is not None:
            self.known_scale[min(mine, theirs)] = stayed


def _sigma_log(best: Link, links: list[Link]) -> float:
    """Standard deviation of the log scale of the best of some links that agree."""
    between = float(np.std([np.log(sim3.scale_of(one.S)) for one in links]))
    return float(np.sqrt(best.sigma_log**2 + best.bend_log**2 + between**2))


def _is_mapped(keyframe: Keyframe) -> bool:
    return bool((keyframe.anchor != NO_ANCHOR).any())


def _apart_enough(one: Link, other: Link) -> bool:
    """Whether two links' keyframes are two witnesses, not one image twice."""
    there = MIN_BASELINE * one.depth
    here = there / sim3.scale_of(one.S)
    return _differ(one.keyframe, other.keyframe, here) and _differ(one.other, other.other, there)


def _differ(a: Keyframe, b: Keyframe, baseline: float) -> bool:
    """Whether two keyframes show a place from two places or in two directions."""
    return float(np.linalg.norm(a.centre_w - b.centre_w)) > baseline or _turn_rad(a, b) > MIN_TURN_RAD


def _turn_rad(a: Keyframe, b: Keyframe) -> float:
    """Angle between the directions in which two keyframes look."""
    return float(np.arccos(np.clip(a.T_c_w[2, :3] @ b.T_c_w[2, :3], -1.0, 1.0)))
