"""Loop closure inside one submap: the drift, and its distribution over the submap.

Two keyframes that show one place at both ends of a long path give the correction of the newer one (`links.py`). A pose
graph of all keyframes of the submap (`optim/pose_graph.py`) distributes it over the path; anchors, edges and frames
move with their keyframes. Refinement follows.
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
"""Minimum age of a keyframe for a loop; younger ones are still in the window."""
MIN_SHARED = 15
"""Common anchors from which on two keyframes are covisible, as in `SlamMap.covisible`."""
NEIGHBOURS = 10
"""Maximum number of graph edges from a keyframe to older covisible ones."""
LOOP_SHARE = 0.2
"""Share of the anchors in view that must be matched at the other end. Repetitive wallpaper reaches 0.16 at a wrong
place; a true revisit 0.2 to 0.4."""
MAX_DRIFT = 0.1
"""Maximum drift as a share of the path length, several times the typical 1 to 3 %. A match beyond it is a similar
place, such as another door or a repetition of the wallpaper."""
MAX_SENSOR_DRIFT = 0.03
"""The same for a submap with metric scale and heading from the drone's sensors; on repetitive wallpaper the gate must
stay below one period after tens of metres."""
MAX_DRIFT_RAD = np.deg2rad(20.0)
"""Maximum drift of the rotation."""
DRIFT_LOG = 0.03
"""Standard deviation of the drift of the log scale between consecutive keyframes, a random walk: a factor of 1.12 after
15 keyframes, 1.4 after 126."""
_BRIDGE_SHARED = 100
"""Equivalent number of common keypoints of a motion predicted by sensors, accurate to centimetres."""
_MIN_DISTANCE = 1e-9
"""Minimum length of a graph edge [map units]; a sparse graph takes 0 for a missing edge."""
WITHIN_PX = 5.0
"""Offset up to which tracking and the window find the old anchors without a loop (`mapping/local_loop_closure.py`)."""
SIGMAS = 3.0
"""Gate for differences of scale."""
WITHIN_LOG = 0.1
"""Standard deviation of the log scale of a view relative to its neighbourhood of seconds, for which telemetry gives the
scale."""
MIN_BASELINE = 0.02
"""Minimum distance of two keyframes relative to the depth: bounds the weight of their relative scale from below."""


@dataclass(frozen=True, slots=True)
class Drift:
    """Predicted log factor by which a loop scales its newer end, before it is closed."""

    log: float
    sigma: float

    def allows(self, log: float) -> bool:
        """Whether this logarithm of the factor passes the gate."""
        return abs(log - self.log) <= SIGMAS * self.sigma


def expected_drift(here: ScaleEstimate | None, there: ScaleEstimate | None) -> Drift | None:
    """From metres per map unit at the newer and the older end of a loop; None unless both are known."""
    if here is None or there is None:
        return None
    relative = np.array([here.sigma / here.value, there.sigma / there.value, WITHIN_LOG])
    return Drift(float(np.log(here.value / there.value)), float(np.linalg.norm(relative)))


@dataclass(frozen=True, slots=True)
class Bridge:
    """Relative pose by the drone's sensors of two consecutive keyframes between which the camera was lost."""

    newer: int
    """Id of the first keyframe of a submap."""
    older: int
    """Id of the keyframe before."""
    T: FloatArray
    """``(4, 4)`` camera of the older one to that of the newer one, in the older one's scale."""

    def scaled(self, scale: float) -> "Bridge":
        """The same after a change of the older one's scale."""
        return replace(self, T=se3.scaled(self.T, scale))


@dataclass(frozen=True, slots=True)
class Closure:
    """A closed loop."""

    stamp_s: float
    """Stamp of the confirming keyframe."""
    piece: int
    away_s: float
    """Time since the previous visit; infinite for an earlier flight."""
    shift: float
    """Correction of the camera's position, relative to the depth."""
    turn_rad: float
    scale: float
    """Change of scale at the newer end."""
    links: int
    """Number of keyframes that agreed."""
    matches: int
    """Number of their matched keypoints."""
    scale_change: dict[int, float]
    """Change of scale at each keyframe, including removed ones."""

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Change of scale at a keyframe."""
        return self.scale_change.get(keyframe_id, 1.0)

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        since = f"after {self.away_s:.1f} s" if np.isfinite(self.away_s) else "from an earlier flight"
        return (
            f"loop closed in piece {self.piece}, a place seen again {since}: {self.links} keyframes agree, "
            f"{self.matches} keypoints; the camera was off by {100 * self.shift:.0f} % of the depth and "
            f"{np.rad2deg(self.turn_rad):.1f} degrees, the map scaled by {self.scale:.3f} there"
        )


def as_it_is(*_: Keyframe) -> tuple[float, float]:
    """Scale of the older end of a loop relative to the newer one without parallax: equal within the drift. The loop
    then corrects position and rotation."""
    return 1.0, WITHIN_LOG


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


def is_plausible(slam_map: SlamMap, link: Link, expected: Drift | None = None, metric: bool = False) -> bool:
    """Whether the drift that a link implies is plausible for the path from its older keyframe to its newer one.

    The path is the shortest one over covisible keyframes: after a loop closure the drift nearby is small.

    Args:
        slam_map: With both ends.
        link: Between them.
        expected: Drift of the scale by other sensors.
        metric: Whether the submap's metric scale is known from the drone's sensors.
    """
    length, steps = _shortest_path(slam_map, link)
    shift, turn = _off(link, link.keyframe.T_c_w)
    drift_share = MAX_SENSOR_DRIFT if metric else MAX_DRIFT
    near = shift * link.depth <= drift_share * length + MAX_SHIFT * link.depth
    drift = expected or Drift(0.0, DRIFT_LOG * np.sqrt(steps))
    return near and turn <= MAX_DRIFT_RAD and drift.allows(float(np.log(sim3.scale_of(link.S))))


def _shortest_path(slam_map: SlamMap, link: Link) -> tuple[float, int]:
    """Length of the shortest path between a link's keyframes over consecutive and covisible ones, and its number of
    steps.

    A covisible edge counts the keyframes that it skips; a loop closure counts as `NEIGHBOURS` at most.
    """
    piece = slam_map.piece_of(link.keyframe.id)
    members = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    row_of = {k.id: row for row, k in enumerate(members)}
    here, there = row_of[link.keyframe.id], row_of[link.other.id]
    ways = _distances(slam_map, members, np.ones(len(members)))
    length, before = dijkstra(ways, directed=False, indices=here, return_predecessors=True)
    steps, at = 1, there
    while at != here:
        steps, at = steps + min(abs(at - int(before[at])), NEIGHBOURS), int(before[at])
    return float(length[there]), steps


def _distances(slam_map: SlamMap, members: list[Keyframe], weight: FloatArray) -> csr_array:
    """Distances of keyframes ``(K,)`` to the previous one and to covisible ones, times the weight ``(K,)`` of the newer
    one."""
    centre = np.stack([k.centre_w for k in members])
    i, j = np.array(list(_shared(slam_map, members)), dtype=np.int64).reshape(-1, 2).T
    distance = np.linalg.norm(centre[i] - centre[j], axis=1) * weight[i] + _MIN_DISTANCE
    return csr_array((distance, (i, j)), shape=(len(members), len(members)))


def is_near_prediction(slam_map: SlamMap, link: Link, sigma: float) -> bool:
    """Whether the relative pose of two submaps by a link agrees with the sensors' prediction of the newer one's start,
    within its uncertainty and the drift of the maps.

    Both ends of a corridor may look the same, including the depths.

    Args:
        slam_map: With both submaps.
        link: Between them.
        sigma: Standard deviation per axis of the newer one's start [map units].
    """
    shift, turn = _off(link, link.keyframe.T_c_w)
    near = is_near(slam_map, link.keyframe, link.other, shift * link.depth, link.depth, sigma)
    return near and turn <= MAX_DRIFT_RAD


def is_near(slam_map: SlamMap, one: Keyframe, other: Keyframe, shift: float, depth: float, sigma: float) -> bool:
    """Whether a camera's distance from the sensors' prediction is within prediction error and drift of the map.

    Args:
        slam_map: With the keyframes.
        one: One end of the path.
        other: Its other end.
        shift: Distance from the prediction [map units].
        depth: Median depth in the camera.
        sigma: Standard deviation of the prediction per axis.
    """
    more = shift - MAX_SHIFT * depth - SIGMAS * sigma
    return more <= 0.0 or more <= _drift(slam_map, one, other)  # as slow as a frame in a large map


def _drift(slam_map: SlamMap, one: Keyframe, other: Keyframe) -> float:
    """Maximum drift between two keyframes of a map with sensors, along the path with the least drift [map units]. The
    scale of a submap that is not merged with the oldest one may be wrong for a while."""
    members = [k for _, k in sorted(slam_map.keyframes.items())]
    oldest = min(slam_map.piece_of(one.id), slam_map.piece_of(other.id))
    share = np.array([MAX_SENSOR_DRIFT if slam_map.piece_of(k.id) == oldest else MAX_DRIFT for k in members])
    row_of = {k.id: row for row, k in enumerate(members)}
    ways = _distances(slam_map, members, share)
    return float(dijkstra(ways, directed=False, indices=row_of[one.id])[row_of[other.id]])


def is_within_reach(slam_map: SlamMap, camera: Camera, link: Link) -> bool:
    """Whether the correction by a link is small enough for the window."""
    p_c = se3.transform(link.keyframe.T_c_w, slam_map.anchors.p_w[link.anchor])
    if not (p_c[:, 2] > 0).all():
        return False
    off = np.linalg.norm(camera.project(p_c) - link.keyframe.features.uv[link.keypoint], axis=1)
    sigma = np.hypot(link.sigma_log, link.bend_log)
    return bool(np.median(off) <= WITHIN_PX and abs(np.log(sim3.scale_of(link.S))) <= SIGMAS * sigma)


def bridge(slam_map: SlamMap, piece: int, other: int) -> Bridge | None:
    """Between two consecutive submaps; None if another one lies between them in time."""
    newer = max(piece, other)
    first = min(k for k in slam_map.keyframes if slam_map.piece_of(k) == newer)
    before = max((k for k in slam_map.keyframes if k < first), default=None)
    if before is None or slam_map.piece_of(before) != min(piece, other):
        return None
    newer_T, older_T = (slam_map.keyframes[k].T_c_w for k in (first, before))
    return Bridge(first, before, newer_T @ se3.inverse(older_T))


def spread(
    slam_map: SlamMap, edges: EdgeMap, log: TrajectoryLog, links: list[Link], sensed: Bridge | None = None
) -> Closure:
    """Move a submap so that both ends of a loop agree, each keyframe by its share.

    Args:
        slam_map: With the submap.
        edges: Measured edges, which move with their keyframes.
        log: Frames, which move with their keyframes.
        links: Between both ends.
        sensed: Relative pose by sensors of two keyframes without common anchors.
    """
    best = max(links, key=lambda one: len(one.keypoint))
    piece = slam_map.piece_of(best.keyframe.id)
    before = best.keyframe.T_c_w
    members = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    graph = _graph(slam_map, members, links, sensed)
    S = {k.id: np.linalg.inv(new) @ k.T_c_w for k, new in zip(members, solve(graph), strict=True)}
    with slam_map.lock:
        for id, ids in _hosted(slam_map, members).items():
            move_anchors(slam_map.anchors, ids, S[id])
        move_keyframes(slam_map, edges, log, S)
    change = {id: sim3.scale_of(moved) for id, moved in S.items()}
    change |= {id: change[successor] for id in slam_map.links if (successor := slam_map.resolve(id)[0]) in change}
    shift, turn = _off(best, before)
    return Closure(
        max(one.keyframe.stamp_s for one in links),
        piece,
        best.keyframe.stamp_s - best.other.stamp_s,
        shift,
        turn,
        change[best.keyframe.id],
        len(links),
        sum(len(one.keypoint) for one in links),
        change,
    )


def _off(link: Link, T_c_w: FloatArray) -> tuple[float, float]:
    """Difference between a camera pose and the one by a link: distance relative to the depth, and angle [rad]."""
    there = sim3.moved_camera(link.S, T_c_w)
    moved = T_c_w @ se3.inverse(there)
    return float(np.linalg.norm(moved[:3, 3])) / link.depth, float(np.linalg.norm(se3.log(moved)[3:]))


def _graph(slam_map: SlamMap, members: list[Keyframe], links: list[Link], sensed: Bridge | None) -> PoseGraph:
    """Keyframes in order with covisibility, link and sensor edges."""
    row_of = {k.id: row for row, k in enumerate(members)}
    depth = [slam_map.median_depth(k) or 1.0 for k in members]
    T = np.stack([k.T_c_w for k in members])
    pairs = _shared(slam_map, members)
    i, j, S_ij, inv_sigma = [], [], [], []
    if sensed is not None:
        i.append(row_of[sensed.newer])
        j.append(row_of[sensed.older])
        pairs.pop((i[0], j[0]), None)
        S_ij.append(sensed.T)
        inv_sigma.append(_inv_sigma(_BRIDGE_SHARED, depth[i[0]], 1.0))
    for (a, b), count in pairs.items():
        i.append(a)
        j.append(b)
        S_ij.append(T[a] @ se3.inverse(T[b]))
        distance = float(np.linalg.norm(S_ij[-1][:3, 3])) / depth[a]
        inv_sigma.append(_inv_sigma(count, depth[a], max(distance, MIN_BASELINE)))
    for link in links:
        i.append(row_of[link.keyframe.id])
        j.append(row_of[link.other.id])
        S_ij.append(T[i[-1]] @ sim3.inverse(link.S) @ se3.inverse(T[j[-1]]))
        inv_sigma.append(_inv_sigma(len(link.keypoint), depth[i[-1]], 1.0 if link.by_images else MIN_BASELINE))
    old = np.flatnonzero([k.stamp_s == BEFORE_S for k in members])
    fixed = old if len(old) else np.zeros(1, dtype=np.int64)  # keyframes of an earlier flight define axes and scale
    return PoseGraph(T, fixed, np.array(i), np.array(j), np.stack(S_ij), np.stack(inv_sigma))


def _inv_sigma(shared: int, depth: float, distance: float) -> FloatArray:
    """Weights ``(7,)`` of an edge, up to a common factor.

    Every common keypoint gives a direction. That constrains the rotation, the translation relative to the depth, and
    the scale by parallax: less the shorter the baseline.

    Args:
        shared: Number of keypoints.
        depth: Median depth in the keyframe [map units].
        distance: Distance of the keyframes, relative to the depth.
    """
    return np.sqrt(max(shared, 1)) * np.array([1.0 / depth] * 3 + [1.0] * 3 + [min(distance, 1.0)])


def _shared(slam_map: SlamMap, members: list[Keyframe]) -> dict[tuple[int, int], int]:
    """Number of common anchors of pairs of keyframes, by rows, newer one first: best pairs, and consecutive ones."""
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
    """Ids of the anchors that move with each keyframe: the host of their depth prior, or the newest observer."""
    anchors = slam_map.anchors
    owner = np.full(len(anchors.alive) + 1, -1, dtype=np.int64)  # the last row is for NO_ANCHOR
    for keyframe in members:
        owner[keyframe.anchor] = keyframe.id
    owner = owner[:-1]
    alive = {k.id for k in members}
    for id in np.flatnonzero((owner >= 0) & anchors.from_depth):
        successor = slam_map.resolve(int(anchors.host[id]))[0] if anchors.host[id] >= 0 else -1
        owner[id] = successor if successor in alive else owner[id]
    return {k.id: np.flatnonzero(owner == k.id) for k in members}
