"""The submap graph: what is known of the relative pose and scale of two places before images compare them.

Nodes are submaps. A later submap begins at a predicted pose: that is a link to the one before, with the covariance of
the drone's sensors, or none without them. Inside a submap the map drifts along covisible keyframes. Images add the
links that merge submaps and close loops (`atlas/atlas.py`); they are believed if they agree with
`SubmapGraph.between`.
"""

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch import gate
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.types import FloatArray, ScaleEstimate

DRIFT = 0.02
"""Standard deviation of the map's drift per axis, as a share of the path; monocular maps drift by 1 to 3 %."""
YOUNG_DRIFT = 0.08
"""The same in a map of a few seconds, whose parallax hardly tells a motion across the view from a turn: take-offs that
rise straight are seen to lean by up to a fifth."""
SENSOR_DRIFT = 0.01
"""The same where the drone's sensors measure metres; on repetitive wallpaper the gate must stay below one period after
tens of metres."""
DRIFT_RAD = math.radians(4.7)
"""Standard deviation of the drift of the rotation."""
DRIFT_LOG = 0.02
"""Standard deviation of the drift of the log scale between consecutive keyframes, a random walk."""
PLACE = 0.03
"""Standard deviation of a camera's place by images alone, relative to the depth."""
PLACE_LOG = 0.07
"""Standard deviation of the log scale of a view relative to its neighbourhood."""
MIN_SHARED = 15
"""Common anchors from which on two keyframes are covisible, as in `SlamMap.covisible`."""
SENSORS = frozenset({"telemetry", "height", "imu"})
"""Sources of a scale that measure metres along the path."""
NEIGHBOURS = 10
"""Maximum number of graph edges from a keyframe to older covisible ones."""
_MIN_DISTANCE = 1e-9
"""Minimum length of a graph edge [map units]; a sparse graph takes 0 for a missing edge."""


@dataclass(frozen=True, slots=True)
class Belief:
    """Expected correction of a camera in the map of another place, with its standard deviations per axis."""

    sigma_t: float
    """[map units]"""
    sigma_r_rad: float
    sigma_log: float = math.inf
    """Of the scale."""

    def allows(self, S: FloatArray, T_c_w: FloatArray) -> bool:
        """Whether a similarity ``(4, 4)`` that images measured for a camera ``(4, 4)`` passes the gate."""
        return self.allows_pose(T_c_w, sim3.moved_camera(S, T_c_w), math.log(sim3.scale_of(S)))

    def allows_pose(self, T_c_w: FloatArray, measured: FloatArray, log_scale: float | None = None) -> bool:
        """The same of an expected and a measured pose ``(4, 4)``, and of a log scale if one was measured."""
        off = T_c_w @ se3.inverse(measured)
        sigma_log = math.inf if log_scale is None else self.sigma_log
        residual = np.concatenate([off[:3, 3], se3.log(off)[3:], [log_scale or 0.0]])
        sigma = np.repeat([self.sigma_t, self.sigma_r_rad, sigma_log], [3, 3, 1])
        return gate.passes(residual, np.diag(sigma**2))

    def plus(self, sigma_t: float, sigma_r_rad: float) -> "Belief":
        """With independent errors of the pose added."""
        return Belief(math.hypot(self.sigma_t, sigma_t), math.hypot(self.sigma_r_rad, sigma_r_rad), self.sigma_log)


@dataclass(frozen=True, slots=True)
class _Start:
    """Link by sensors from a submap to the first one, at the keyframe where it begins."""

    keyframe_id: int
    sigma_t: float
    """Standard deviation of its centre per axis [map units]."""
    sigma_r_rad: float
    one_unit: bool
    """Whether sensors bring the submap to the unit of the first one."""


@dataclass(slots=True)
class SubmapGraph:
    """Links by sensors between the submaps of a flight, and drift inside them."""

    map: SlamMap
    log: TrajectoryLog
    scale_now: Callable[[], ScaleEstimate] = ScaleEstimate
    """Present metres per map unit."""
    starts: dict[int, _Start] = field(default_factory=dict)
    """By the number of the submap."""
    _path: dict[int, float] = field(default_factory=dict)
    """Length of the shortest covisibility path [map units] from the first keyframe to others, by their ids."""
    path: float = 0.0
    """That of the newest keyframe, along which the map has drifted."""

    def begin(self, piece: int, keyframe: Keyframe, sigma_t: float, sigma_r_rad: float, one_unit: bool = False) -> None:
        """Add a submap that begins at a keyframe in the map, at a pose predicted with standard deviations per axis
        from the previous submap; infinite ones without sensors. Sensors bring it to the first one's unit or not."""
        before = next((p for r in reversed(self.log.records) if (p := self.map.piece_of(r.keyframe_id)) != piece), None)
        if before is None:
            return
        earlier_t, earlier_r = self.uncertainty(before, self.first, keyframe.centre_w)
        sigma = math.hypot(sigma_t, earlier_t), math.hypot(sigma_r_rad, earlier_r)
        self.starts[piece] = _Start(keyframe.id, *sigma, one_unit)

    @property
    def first(self) -> int:
        """Number of the submap in which the flight began."""
        return self.map.piece_of(self.log.records[0].keyframe_id)

    def add(self, keyframe: Keyframe) -> None:
        """Update the path with a mapped keyframe: a revisit makes it short again."""
        near = [k for k in self.map.covisible(keyframe, NEIGHBOURS) if k.id in self._path]
        paths = [self._path[k.id] + float(np.linalg.norm(k.centre_w - keyframe.centre_w)) for k in near]
        self._path[keyframe.id] = min(paths, default=self.path)
        self.path = self._path[keyframe.id]

    # -- marginals ---------------------------------------------------------------------------------------------

    def uncertainty(self, piece: int, other: int, centre: FloatArray) -> tuple[float, float]:
        """Standard deviations per axis [map units, rad] of a camera ``(3,)`` of one submap as seen from another, by
        the sensors' links; infinite if unrelated, as submaps of earlier flights.

        Errors of rotation and of both scales grow with the distance from where a submap begins.
        """
        variance = np.zeros(2)
        scale = self.scale_now()
        for submap in {piece, other} - {self.first} if piece != other else ():
            start = self.starts.get(submap)
            if start is None:
                return math.inf, math.inf
            with self.map.lock:
                began = se3.inverse(self.map.pose_of(start.keyframe_id))[:3, 3]
            way = float(np.linalg.norm(centre - began))
            lever = way * math.hypot(start.sigma_r_rad, math.sqrt(2.0) * scale.sigma / scale.value) if way else 0.0
            variance += start.sigma_t**2 + lever**2, start.sigma_r_rad**2
        return math.sqrt(variance[0]), math.sqrt(variance[1])

    def between(self, one: Keyframe, other: Keyframe, depth: float) -> Belief | None:
        """Correction to be expected of a keyframe's pose in the map of another; None if nothing relates them.

        Args:
            one: In the map.
            other: Likewise.
            depth: Median depth of what is seen [map units].
        """
        mine, theirs = (self.map.piece_of(k.id) for k in (one, other))
        one_map = mine == theirs
        if not one_map and BEFORE_S in (one.stamp_s, other.stamp_s):
            return None
        sigma_t, sigma_r = self.uncertainty(mine, theirs, one.centre_w)
        relative_log = math.inf if one_map else self._relative_log(mine, theirs)
        if not math.isfinite(sigma_t):
            return Belief(math.inf, math.inf, relative_log) if math.isfinite(relative_log) else None
        drift, steps = self._drift(one, other)
        sigma_t, sigma_r = math.hypot(sigma_t, drift, PLACE * depth), math.hypot(sigma_r, DRIFT_RAD)
        return Belief(sigma_t, sigma_r, DRIFT_LOG * math.sqrt(steps) if one_map else relative_log)

    def _relative_log(self, piece: int, other: int) -> float:
        """Standard deviation of the log scale of one submap relative to another by sensors, which bring the newest one
        to the unit of that in which the flight began. Infinite for others."""
        scale, newest = self.scale_now(), self.map.piece_of(self.log.records[-1].keyframe_id)
        start = self.starts.get(newest)
        if start is None or not start.one_unit or {piece, other} != {self.first, newest}:
            return math.inf
        if SENSORS.isdisjoint(scale.source.split("+")):
            return math.inf
        return math.sqrt(2.0) * scale.sigma / scale.value

    def _drift(self, one: Keyframe, other: Keyframe) -> tuple[float, int]:
        """Standard deviation of the drift per axis along the path between two keyframes with the least of it, over
        consecutive and covisible ones, and its number of steps.

        A covisible edge counts the keyframes that it skips; a loop closure counts as `NEIGHBOURS` at most. The scale of
        a submap that is not merged with the oldest one may be wrong for a while, also with sensors.
        """
        members = [k for _, k in sorted(self.map.keyframes.items())]
        row_of = {k.id: row for row, k in enumerate(members)}
        oldest = min(self.map.piece_of(one.id), self.map.piece_of(other.id))
        drift_share = DRIFT if SENSORS.isdisjoint(self.scale_now().source.split("+")) else SENSOR_DRIFT
        share = np.array([drift_share if self.map.piece_of(k.id) == oldest else DRIFT for k in members])
        centre = np.stack([k.centre_w for k in members])
        i, j = np.array(list(shared_anchors(self.map, members)), dtype=np.int64).reshape(-1, 2).T
        edge = np.linalg.norm(centre[i] - centre[j], axis=1) * share[i] + _MIN_DISTANCE
        ways: dict[int, list[tuple[int, float]]] = {row: [] for row in range(len(members))}
        for a, b, length in zip(i.tolist(), j.tolist(), edge.tolist(), strict=True):
            ways[a].append((b, length))
            ways[b].append((a, length))
        return _least_drift(ways, row_of[one.id], row_of[other.id])


def _least_drift(ways: dict[int, list[tuple[int, float]]], here: int, there: int) -> tuple[float, int]:
    """Length and steps of the shortest way between two nodes of a connected graph (Dijkstra)."""
    done: set[int] = set()
    reached = [(0.0, 1, here)]
    while reached[0][2] != there:
        drift, steps, at = heapq.heappop(reached)
        if at in done:
            continue
        done.add(at)
        for other, length in ways[at]:
            heapq.heappush(reached, (drift + length, steps + min(abs(at - other), NEIGHBOURS), other))
    return reached[0][:2]


def shared_anchors(slam_map: SlamMap, members: list[Keyframe]) -> dict[tuple[int, int], int]:
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
