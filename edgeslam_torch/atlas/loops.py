"""A loop inside one piece of map: what its drift was, and how the whole piece makes up for it.

Two keyframes that see one place from two ends of a long way say where the newer one should be (`links.py`). A graph of
all keyframes of the piece (`optim/pose_graph.py`) spreads this over the way between; anchors, edges and frames follow
their keyframes. What is left is for the refinement that follows.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from edgeslam_torch.atlas.links import MAX_SHIFT, Link
from edgeslam_torch.atlas.map_merging import move_anchors, move_keyframes
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.optim.pose_graph import PoseGraph, solve
from edgeslam_torch.types import FloatArray, IntArray, ScaleEstimate

MIN_AWAY_S = 5.0
"""Time since an older keyframe from which on it may close a loop; before, the window has not lost it yet."""
MIN_SHARED = 15
"""Anchors in common from which on two keyframes are covisible, as in `SlamMap.covisible`."""
NEIGHBOURS = 10
"""Edges from a keyframe to the older ones that it shares most anchors with."""
LOOP_SHARE = 0.2
"""Share of the anchors in view that must be found at the other end. A wall whose paper repeats reaches 0.16 at a wrong
place, a hundred keypoints with one scale; a right place 0.2 to 0.4 once the camera is there, and a loop can wait."""
MAX_DRIFT = 0.1
"""Most that a map drifts, in shares of the way: several times the usual 1 to 3 %. A place that is farther from where
the map has it is another one that looks alike, as doors and wallpaper do."""
HELD_DRIFT = 0.03
"""The same of a piece of map whose metres and heading the drone's sensors hold: a wall whose paper repeats every 1.6 m
is no place that one comes back to after 17 m."""
MAX_DRIFT_RAD = np.deg2rad(20.0)
"""Most that it turns."""
DRIFT_LOG = 0.03
"""Standard deviation of what the log scale drifts from one keyframe to the next, a random walk: after 15 keyframes, as
few as a loop has, a factor of 1.12, after the 126 of a round through ten rooms one of 1.4 (2.1 was measured)."""
_CARRIED_SHARED = 100
"""Keypoints that a way without images is worth: as much as one between usual keyframes. It drifts by centimetres."""
_NO_WAY = 1e-9
"""Length of a way between two cameras in one place [map units]: a graph takes 0 for no way at all."""
WITHIN_PX = 5.0
"""Offset up to which tracking and the window find the old anchors by themselves (`mapping/local_loop_closure.py`)."""
SIGMAS = 3.0
"""Difference of scale beyond which it is not chance."""
WITHIN_LOG = 0.1
"""Standard deviation of the log scale of a view against that of the seconds around it, of which telemetry tells: in its
first ten seconds a map of ten rooms grows by a third."""
MIN_BASELINE = 0.02
"""Least distance of two keyframes relative to the depth: without parallax the scale between them is anybody's guess,
but not worse than this."""


@dataclass(frozen=True, slots=True)
class Drift:
    """What is known, before a loop is closed, of the factor by which it scales its newer end."""

    log: float
    sigma: float

    def allows(self, log: float) -> bool:
        """Whether this logarithm of the factor can be right."""
        return abs(log - self.log) <= SIGMAS * self.sigma


def drift_told(here: ScaleEstimate | None, there: ScaleEstimate | None) -> Drift | None:
    """By metres per map unit at the newer and at the older end of a loop; None unless both are known."""
    if here is None or there is None:
        return None
    relative = np.array([here.sigma / here.value, there.sigma / there.value, WITHIN_LOG])
    return Drift(float(np.log(here.value / there.value)), float(np.linalg.norm(relative)))


@dataclass(frozen=True, slots=True)
class Bridge:
    """What the drone's sensors say of two keyframes in sequence between which the camera was lost."""

    newer: int
    """Id of the first keyframe of a piece."""
    older: int
    """Id of the last one before."""
    T: FloatArray
    """``(4, 4)`` camera of the older one to that of the newer one, in the older one's unit."""

    def scaled(self, scale: float) -> "Bridge":
        """The same after the older one's unit was scaled."""
        return replace(self, T=se3.scaled(self.T, scale))


@dataclass(frozen=True, slots=True)
class Closure:
    """A loop that was closed."""

    stamp_s: float
    """Of the keyframe that settled it."""
    piece: int
    away_s: float
    """Time since the place was seen before; infinite for an earlier flight."""
    shift: float
    """How far the camera was off, relative to the depth that it sees."""
    turn_rad: float
    scale: float
    """Factor by which the map grew at the newer end."""
    links: int
    """Keyframes that agreed."""
    matches: int
    """Keypoints of these that show the older end."""
    grown: dict[int, float]
    """Factor by which the map grew around each keyframe, removed ones included."""

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Factor by which the map grew around a keyframe."""
        return self.grown.get(keyframe_id, 1.0)

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        since = f"after {self.away_s:.1f} s" if np.isfinite(self.away_s) else "from an earlier flight"
        return (
            f"loop closed in piece {self.piece}, a place seen again {since}: {self.links} keyframes agree, "
            f"{self.matches} keypoints; the camera was off by {100 * self.shift:.0f} % of the depth and "
            f"{np.rad2deg(self.turn_rad):.1f} degrees, the map scaled by {self.scale:.3f} there"
        )


def as_it_is(*_: Keyframe) -> tuple[float, float]:
    """Size of the older end of a loop relative to the newer one, where images tell none: a piece has one unit, within
    what it drifts. The loop then tells where its newer end is, and how that is turned."""
    return 1.0, WITHIN_LOG


def far_keyframes(slam_map: SlamMap, keyframe: Keyframe) -> list[Keyframe]:
    """Older keyframes of the same piece that a keyframe is connected with only by a long way.

    Those are left out that share anchors with it, or with keyframes that do.
    """
    piece = slam_map.piece_of(keyframe.id)
    older = [k for k in slam_map.keyframes.values() if keyframe.stamp_s - k.stamp_s >= MIN_AWAY_S]
    older = [k for k in older if slam_map.piece_of(k.id) == piece]
    if not older:
        return []
    around = slam_map.anchors_seen_by([keyframe, *slam_map.covisible(keyframe, len(slam_map.keyframes), MIN_SHARED)])
    near = slam_map.shared_counts(around)
    return [k for k in older if near.get(k.id, 0) < MIN_SHARED]


def is_plausible(slam_map: SlamMap, link: Link, told: Drift | None = None, held: bool = False) -> bool:
    """Whether a map can have drifted as much as a link says on the way from its older keyframe to its newer one.

    That is the shortest of those that the map knows: once a loop is closed, what is near to it has hardly drifted.

    Args:
        slam_map: With both ends.
        link: Between them.
        told: What others than the images say of how its scale drifted.
        held: Whether the drone's sensors hold the piece: its metres are known, if not at this moment.
    """
    way, steps = _shortest_way(slam_map, link)
    shift, turn = _off(link, link.keyframe.T_c_w)
    drift_share = HELD_DRIFT if held else MAX_DRIFT
    near = shift * link.depth <= drift_share * way + MAX_SHIFT * link.depth
    drift = told or Drift(0.0, DRIFT_LOG * np.sqrt(steps))
    return near and turn <= MAX_DRIFT_RAD and drift.allows(float(np.log(sim3.scale_of(link.S))))


def _shortest_way(slam_map: SlamMap, link: Link) -> tuple[float, int]:
    """Length of the shortest way between a link's keyframes, from each to the next or to one that sees the same.

    And how many there are on it: those that it passes over count, but not those of a loop that is closed.
    """
    piece = slam_map.piece_of(link.keyframe.id)
    members = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    row_of = {k.id: row for row, k in enumerate(members)}
    here, there = row_of[link.keyframe.id], row_of[link.other.id]
    ways = _ways(slam_map, members, np.ones(len(members)))
    length, before = dijkstra(ways, directed=False, indices=here, return_predecessors=True)
    steps, at = 1, there
    while at != here:
        steps, at = steps + min(abs(at - int(before[at])), NEIGHBOURS), int(before[at])
    return float(length[there]), steps


def _ways(slam_map: SlamMap, members: list[Keyframe], weight: FloatArray) -> csr_array:
    """Lengths of the ways from keyframes ``(K,)`` to the one before and to those that see the same, each times the
    weight ``(K,)`` of the newer one."""
    centre = np.stack([k.centre_w for k in members])
    i, j = np.array(list(_shared(slam_map, members)), dtype=np.int64).reshape(-1, 2).T
    apart = np.linalg.norm(centre[i] - centre[j], axis=1) * weight[i] + _NO_WAY
    return csr_array((apart, (i, j)), shape=(len(members), len(members)))


def is_carried(slam_map: SlamMap, link: Link, sigma: float) -> bool:
    """Whether two pieces can lie to each other as a link says, the newer one of which was begun where the drone's
    sensors had carried the camera: nothing but their drift and that of the maps on the way is between them.

    Both ends of a corridor look alike, doors, depths and all; they are not where the drone can have come to.

    Args:
        slam_map: With both pieces.
        link: Between them.
        sigma: Standard deviation per axis of where the newer one began [map units].
    """
    shift, turn = _off(link, link.keyframe.T_c_w)
    near = is_near(slam_map, link.keyframe, link.other, shift * link.depth, link.depth, sigma)
    return near and turn <= MAX_DRIFT_RAD


def is_near(slam_map: SlamMap, one: Keyframe, other: Keyframe, shift: float, depth: float, sigma: float) -> bool:
    """Whether a camera can be this far from where the drone's sensors say, on a map that has drifted on the way.

    Args:
        slam_map: With the keyframes.
        one: Where the way ends, or begins.
        other: Its other end.
        shift: Distance [map units].
        depth: That the camera sees.
        sigma: Standard deviation per axis of what the sensors say.
    """
    more = shift - MAX_SHIFT * depth - SIGMAS * sigma
    return more <= 0.0 or more <= _drift(slam_map, one, other)  # which takes as long as a frame in a large map


def _drift(slam_map: SlamMap, one: Keyframe, other: Keyframe) -> float:
    """Most that a map which the drone's sensors hold drifts between two keyframes, along the way that the map knows on
    which it does least [map units]. The unit of a piece that is not joined to the older one's may be wrong for a while.
    """
    members = [k for _, k in sorted(slam_map.keyframes.items())]
    oldest = min(slam_map.piece_of(one.id), slam_map.piece_of(other.id))
    share = np.array([HELD_DRIFT if slam_map.piece_of(k.id) == oldest else MAX_DRIFT for k in members])
    row_of = {k.id: row for row, k in enumerate(members)}
    ways = _ways(slam_map, members, share)
    return float(dijkstra(ways, directed=False, indices=row_of[one.id])[row_of[other.id]])


def is_within_reach(slam_map: SlamMap, camera: Camera, link: Link) -> bool:
    """Whether what a link says of the drift is so little that the window makes up for it."""
    p_c = se3.transform(link.keyframe.T_c_w, slam_map.anchors.p_w[link.anchor])
    if not (p_c[:, 2] > 0).all():
        return False
    off = np.linalg.norm(camera.project(p_c) - link.keyframe.features.uv[link.keypoint], axis=1)
    sigma = np.hypot(link.sigma_log, link.bend_log)
    return bool(np.median(off) <= WITHIN_PX and abs(np.log(sim3.scale_of(link.S))) <= SIGMAS * sigma)


def bridge(slam_map: SlamMap, piece: int, other: int) -> Bridge | None:
    """Between two pieces, one of which began when the other was lost; None if another one lies between them in time."""
    newer = max(piece, other)
    first = min(k for k in slam_map.keyframes if slam_map.piece_of(k) == newer)
    before = max((k for k in slam_map.keyframes if k < first), default=None)
    if before is None or slam_map.piece_of(before) != min(piece, other):
        return None
    newer_T, older_T = (slam_map.keyframes[k].T_c_w for k in (first, before))
    return Bridge(first, before, newer_T @ se3.inverse(older_T))


def spread(
    slam_map: SlamMap, edges: EdgeMap, log: TrajectoryLog, links: list[Link], carried: Bridge | None = None
) -> Closure:
    """Move a piece so that both ends of a loop agree, each keyframe by its share.

    Args:
        slam_map: With the piece.
        edges: Measured edges, which move with their keyframes.
        log: Frames, which do so, too.
        links: Between both ends.
        carried: How two keyframes that show nothing in common lay to each other before the links were known.
    """
    best = max(links, key=lambda one: len(one.keypoint))
    piece = slam_map.piece_of(best.keyframe.id)
    before = best.keyframe.T_c_w
    members = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    graph = _graph(slam_map, members, links, carried)
    S = {k.id: np.linalg.inv(new) @ k.T_c_w for k, new in zip(members, solve(graph), strict=True)}
    with slam_map.lock:
        for id, ids in _hosted(slam_map, members).items():
            move_anchors(slam_map.anchors, ids, S[id])
        move_keyframes(slam_map, edges, log, S)
    grown = {id: sim3.scale_of(moved) for id, moved in S.items()}
    grown |= {id: grown[heir] for id in slam_map.links if (heir := slam_map.resolve(id)[0]) in grown}
    shift, turn = _off(best, before)
    return Closure(
        max(one.keyframe.stamp_s for one in links),
        piece,
        best.keyframe.stamp_s - best.other.stamp_s,
        shift,
        turn,
        grown[best.keyframe.id],
        len(links),
        sum(len(one.keypoint) for one in links),
        grown,
    )


def _off(link: Link, T_c_w: FloatArray) -> tuple[float, float]:
    """How far a camera is from where a link says it is: relative to the depth, and the angle [rad]."""
    there = sim3.moved_camera(link.S, T_c_w)
    moved = T_c_w @ se3.inverse(there)
    return float(np.linalg.norm(moved[:3, 3])) / link.depth, float(np.linalg.norm(se3.log(moved)[3:]))


def _graph(slam_map: SlamMap, members: list[Keyframe], links: list[Link], carried: Bridge | None) -> PoseGraph:
    """Keyframes in order, what they share as it is, what the links say, and what the drone's sensors do."""
    row_of = {k.id: row for row, k in enumerate(members)}
    depth = [slam_map.median_depth(k) or 1.0 for k in members]
    T = np.stack([k.T_c_w for k in members])
    pairs = _shared(slam_map, members)
    i, j, S_ij, inv_sigma = [], [], [], []
    if carried is not None:
        i.append(row_of[carried.newer])
        j.append(row_of[carried.older])
        pairs.pop((i[0], j[0]), None)
        S_ij.append(carried.T)
        inv_sigma.append(_inv_sigma(_CARRIED_SHARED, depth[i[0]], 1.0))
    for (a, b), count in pairs.items():
        i.append(a)
        j.append(b)
        S_ij.append(T[a] @ se3.inverse(T[b]))
        apart = float(np.linalg.norm(S_ij[-1][:3, 3])) / depth[a]
        inv_sigma.append(_inv_sigma(count, depth[a], max(apart, MIN_BASELINE)))
    for link in links:
        i.append(row_of[link.keyframe.id])
        j.append(row_of[link.other.id])
        S_ij.append(T[i[-1]] @ sim3.inverse(link.S) @ se3.inverse(T[j[-1]]))
        inv_sigma.append(_inv_sigma(len(link.keypoint), depth[i[-1]], 1.0 if link.by_images else MIN_BASELINE))
    old = np.flatnonzero([k.stamp_s == BEFORE_S for k in members])
    fixed = old if len(old) else np.zeros(1, dtype=np.int64)  # axes and metres of an earlier flight stay
    return PoseGraph(T, fixed, np.array(i), np.array(j), np.stack(S_ij), np.stack(inv_sigma))


def _inv_sigma(shared: int, depth: float, apart: float) -> FloatArray:
    """Weights ``(7,)`` of an edge, up to a common factor.

    Every keypoint that two keyframes share tells a direction. That gives the turn, the shift relative to the depth, and
    the scale by a parallax: worse, the shorter the way between them.

    Args:
        shared: Number of keypoints.
        depth: That the keyframe sees [map units].
        apart: Distance of the keyframes, relative to the depth.
    """
    return np.sqrt(max(shared, 1)) * np.array([1.0 / depth] * 3 + [1.0] * 3 + [min(apart, 1.0)])


def _shared(slam_map: SlamMap, members: list[Keyframe]) -> dict[tuple[int, int], int]:
    """Anchors that pairs of keyframes share, by their rows, newer one first: the best pairs, and those in sequence."""
    row_of = {k.id: row for row, k in enumerate(members)}
    pairs: dict[tuple[int, int], int] = {}
    for row, keyframe in enumerate(members):
        counts = slam_map.shared_counts(keyframe.anchor[keyframe.anchor >= 0])
        older = {row_of[id]: n for id, n in counts.items() if row_of.get(id, row) < row}
        best = sorted((r for r in older if older[r] >= MIN_SHARED), key=lambda r: (-older[r], -r))[:NEIGHBOURS]
        pairs |= {(row, r): older[r] for r in best}
        if row > 0:
            pairs[row, row - 1] = older.get(row - 1, 0)
    return pairs


def _hosted(slam_map: SlamMap, members: list[Keyframe]) -> dict[int, IntArray]:
    """Ids of the anchors that go with each keyframe: the one that their prior rests on, or the newest observer."""
    anchors = slam_map.anchors
    owner = np.full(len(anchors.alive) + 1, -1, dtype=np.int64)  # the last row answers for NO_ANCHOR
    for keyframe in members:
        owner[keyframe.anchor] = keyframe.id
    owner = owner[:-1]
    alive = {k.id for k in members}
    for id in np.flatnonzero((owner >= 0) & anchors.from_depth):
        heir = slam_map.resolve(int(anchors.host[id]))[0] if anchors.host[id] >= 0 else -1
        owner[id] = heir if heir in alive else owner[id]
    return {k.id: np.flatnonzero(owner == k.id) for k in members}
