"""The submaps, and the search for links that merge two of them or close a loop in one.

A false merge corrupts the whole map; a missed one leaves two submaps. Hence a merge or a loop needs two links without a
common keyframe that agree about the similarity.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.atlas.links import LINK_LOG, Link, link, on_one_plane
from edgeslam_torch.atlas.place_recognition import MIN_VOTES, revisit_candidates
from edgeslam_torch.atlas.relaxation import look_around, merge_submaps, move, relaxed, share_anchors
from edgeslam_torch.atlas.submap_graph import MIN_SHARED, PLACE_LOG, SubmapGraph
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe
from edgeslam_torch.map.slam_map import SlamMap
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
MIN_AWAY_S = 5.0
"""Minimum age of a keyframe for a loop; younger ones are still in the window."""
LOOP_SHARE = 0.2
"""Share of the anchors in view that must be matched at the other end. Repetitive wallpaper reaches 0.16 at a wrong
place; a true revisit 0.2 to 0.4."""
LOOP_SEARCH_S = 1.0
"""Time between two searches for loops; each costs half a frame."""
LOOP_SEARCH_RAD = np.deg2rad(20.0)
"""Rotation after which a search is due at once: a third of the view is new."""
LOOP_VOTES = 20
"""Votes for a candidate to be matched: a tenth of `MOST_VOTERS`. True revisits get 30 and more of 200, repetitive
wallpaper 22."""
WITHIN_PX = 5.0
"""Offset up to which tracking and the window find the old anchors without a loop (`mapping/local_loop_closure.py`)."""
WITNESSES = 4
"""Covisible keyframes that are matched to confirm a new link."""


@dataclass(frozen=True, slots=True)
class MapChange:
    """A merge of two submaps, or a closed loop."""

    kind: str
    """Key in the summary's events: ``joined``, ``loops_closed``."""
    stamp_s: float
    """Stamp of the confirming keyframe."""
    text: str
    """For `status.csv` and the summary."""
    scale_change: dict[int, float]
    """Change of scale at each keyframe that was moved, including removed ones."""

    def growth(self, keyframe_id: int) -> float:
        """Change of scale at a keyframe."""
        return self.scale_change.get(keyframe_id, 1.0)

    def __str__(self) -> str:
        return self.text


class Atlas:
    """Matches every new keyframe with other submaps, and with distant parts of its own.

    Args:
        tracker: Contains the map.
        edges: Measured edges, which move with their keyframes.
        graph: What sensors and the map itself say about the relation of two places.
        lm: Settings of the refinement.
        closing: Whether to close loops inside a submap.
    """

    def __init__(
        self, tracker: Tracker, edges: EdgeMap, graph: SubmapGraph, lm: LmConfig, closing: bool = False
    ) -> None:
        self.tracker = tracker
        self.map = tracker.map
        self.edges = edges
        self.graph = graph
        self.lm = lm
        self.closing = closing
        self.changes: list[MapChange] = []
        """In temporal order."""
        self.known_scale: dict[int, ScaleEstimate] = {}
        """Metres per map unit of submaps of earlier flights, by their number."""
        self._links: list[Link] = []
        """Links that no other one has confirmed yet."""
        self._searched = -1
        """Newest keyframe that was searched."""
        self._loop_searched: Keyframe | None = None
        """Newest keyframe that was searched for a loop."""

    def others(self, piece: int) -> list[Keyframe]:
        """Keyframes of other submaps that have anchors."""
        return [k for k in self.map.keyframes.values() if self.map.piece_of(k.id) != piece and _is_mapped(k)]

    @property
    def is_divided(self) -> bool:
        """Whether there are several submaps."""
        return len({self.map.piece_of(id) for id in self.map.keyframes}) > 1

    @property
    def is_up_to_date(self) -> bool:
        """Whether every keyframe was searched."""
        return max(self.map.keyframes, default=-1) <= self._searched

    def update(self) -> MapChange | None:
        """Search the keyframes that are new since the last call; returns the resulting merge or closed loop, if any.

        The caller must own the map.
        """
        for id in sorted(id for id in self.map.keyframes if id > self._searched):
            self._searched = id
            change = self._search(self.map.keyframes[id])
            if change is not None:
                return change
        return None

    def search_all_again(self) -> None:
        """Search every keyframe in the next `update`."""
        self._searched = -1
        self._loop_searched = None

    # -- search ------------------------------------------------------------------------------------------------

    def _search(self, keyframe: Keyframe) -> MapChange | None:
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
        """A verified link that agrees with what is known of the relation of both ends.

        The scale at both ends of a loop without parallax is equal within the drift; such a loop needs depths that are
        not on one plane.
        """
        loop = self.map.piece_of(keyframe.id) == self.map.piece_of(other.id)
        if loop:
            found = link(self.tracker, keyframe, other, LOOP_SHARE, (1.0, PLACE_LOG))
        else:
            found = link(self.tracker, keyframe, other)
        if found is None or (not found.by_images and self._is_flat(found)):
            return None
        belief = self.graph.between(keyframe, other, found.depth)
        if belief is None:
            return found
        if loop or not np.isfinite(belief.sigma_log):
            return found if belief.allows(found.S, keyframe.T_c_w) else None
        allowed = belief.allows_pose(keyframe.T_c_w, sim3.moved_camera(found.S, keyframe.T_c_w))
        return found.in_unit(belief.sigma_log) if allowed else None

    def _is_flat(self, one: Link) -> bool:
        """Whether the anchors of a link lie on one plane, such as a wall with repetitive wallpaper."""
        return on_one_plane(self.map.anchors.p_w[one.anchor], one.depth)

    def _settle(self, found: Link) -> MapChange | None:
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
        return [*known, *filter(None, new)]

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

    # -- changes -----------------------------------------------------------------------------------------------

    def _close(self, links: list[Link]) -> MapChange | None:
        """Close a loop; None if the offset is small, so that sharing anchors suffices."""
        self._links = []
        if all(self._is_within_reach(one) for one in links):
            share_anchors(self.map, links)
            return None
        best = max(links, key=lambda one: len(one.keypoint))
        piece, away_s = self.map.piece_of(best.keyframe.id), best.keyframe.stamp_s - best.other.stamp_s
        off = best.keyframe.T_c_w @ se3.inverse(sim3.moved_camera(best.S, best.keyframe.T_c_w))
        shift, turn = np.linalg.norm(off[:3, 3]) / best.depth, np.linalg.norm(se3.log(off)[3:])
        with self.map.lock:  # a consistent snapshot for readers
            scale_change = self._moved(relaxed(self.map, links))
            share_anchors(self.map, links)
            look_around(self.map, self.tracker.camera, links)  # later windows and the final refinement do the rest
        since = f"after {away_s:.1f} s" if np.isfinite(away_s) else "from an earlier flight"
        return self._changed(
            "loops_closed",
            max(one.keyframe.stamp_s for one in links),
            f"loop closed in piece {piece}, a place seen again {since}: {_evidence(links)}; the camera was off by "
            f"{100 * shift:.0f} % of the depth and {np.rad2deg(turn):.1f} degrees, the map scaled by "
            f"{scale_change[best.keyframe.id]:.3f} there",
            scale_change,
        )

    def _is_within_reach(self, one: Link) -> bool:
        """Whether the correction by a link is small enough for the window."""
        p_c = se3.transform(one.keyframe.T_c_w, self.map.anchors.p_w[one.anchor])
        if not (p_c[:, 2] > 0).all():
            return False
        off = np.linalg.norm(self.tracker.camera.project(p_c) - one.keyframe.features.uv[one.keypoint], axis=1)
        scale = abs(np.log(sim3.scale_of(one.S)))
        return bool(np.median(off) <= WITHIN_PX and scale <= 3.0 * np.hypot(one.sigma_log, LINK_LOG))

    def _join(self, links: list[Link]) -> MapChange:
        """Merge two submaps: the smaller one is moved."""
        best = max(links, key=lambda one: len(one.keypoint))
        mine, theirs = self._pieces(best)
        moved, S = mine, best.S
        if self._weight(mine) > self._weight(theirs):
            moved, S = theirs, sim3.inverse(best.S)
        scale_change = self._moved(dict.fromkeys(self._keyframes_of(moved), S))
        merge_submaps(self.map, self.tracker.camera, links, self.lm)
        scales = {piece: self.known_scale.pop(piece, None) for piece in (mine, theirs)}
        stayed = scales[mine if moved == theirs else theirs]
        if stayed is not None:
            self.known_scale[min(mine, theirs)] = stayed
        return self._changed(
            "joined",
            max(one.keyframe.stamp_s for one in links),
            f"piece {max(mine, theirs)} joined piece {min(mine, theirs)}: {_evidence(links)}, "
            f"piece {moved} scaled by {sim3.scale_of(S):.3f}",
            scale_change,
        )

    def _weight(self, piece: int) -> tuple[bool, int]:
        """Order by which a submap stays: metric scale from an earlier flight, then its size."""
        return piece in self.known_scale, len(self._keyframes_of(piece))

    def _keyframes_of(self, piece: int) -> list[int]:
        return [id for id in self.map.keyframes if self.map.piece_of(id) == piece]

    def _moved(self, similarity: dict[int, FloatArray]) -> dict[int, float]:
        return move(self.map, self.edges, self.graph.log, similarity)

    def _changed(self, kind: str, stamp_s: float, text: str, scale_change: dict[int, float]) -> MapChange:
        """Record a change; waiting links refer to the map before."""
        self._links = []
        change = MapChange(kind, stamp_s, text, scale_change)
        self.changes.append(change)
        return change


def far_keyframes(slam_map: SlamMap, keyframe: Keyframe) -> list[Keyframe]:
    """Older keyframes of the same submap without a short covisibility path to a keyframe.

    Left out are those that share anchors with it or with its covisible keyframes.
    """
    piece = slam_map.piece_of(keyframe.id)
    older = [k for k in slam_map.keyframes.values() if keyframe.stamp_s - k.stamp_s >= MIN_AWAY_S]
    older = [k for k in older if slam_map.piece_of(k.id) == piece]
    if not older:
        return []
    around = slam_map.anchors_seen_by([keyframe, *slam_map.covisible(keyframe, len(slam_map.keyframes), MIN_SHARED)])
    near = slam_map.shared_counts(around)
    return [k for k in older if near.get(k.id, 0) < MIN_SHARED]


def _evidence(links: list[Link]) -> str:
    return f"{len(links)} keyframes agree, {sum(len(one.keypoint) for one in links)} keypoints"


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
