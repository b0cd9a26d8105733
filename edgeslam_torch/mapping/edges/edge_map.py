"""The semi-dense edge map: edge points stay with the keyframe that measured them and move with its pose."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.config import EdgeConfig
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.depth_prior import MIN_ANCHORS, depth_prior
from edgeslam_torch.map.edge_agreement import PaintedEdges, View, bend
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_depth import StereoView, measure_edge_depth
from edgeslam_torch.types import FloatArray, IntArray, PointCloud

AGREE_DEPTH = 0.04
"""Maximum relative depth difference of the same edge in two keyframes."""
DELAY_KEYFRAMES = 3
"""Number of later keyframes before a keyframe's edges are measured, so that refined views from both sides exist."""
TARGETS = 5
"""Keyframes searched for each edge."""
RECENT_HOSTS = 40
"""Number of latest keyframes compared with a new one."""
CHECKED = 100
"""Edges of a keyframe that are measured again to decide whether all must be."""
OFF_LOG = 0.05
"""Median change of their log depth above which all are measured again: twice the largest relative sigma of an edge."""
NEARLY = 0.1
"""Maximum relative standard deviation of the depth of an obstacle: 10 cm at a metre."""
PRIOR_CELL_PX = 8
"""Side of the cells whose edges share a depth prior."""


@dataclass(slots=True)
class EdgePoints:
    """Measured edges of one keyframe, in its camera frame."""

    keyframe_id: int
    uv: FloatArray
    """``(E, 2)``"""
    normal: FloatArray
    """``(E, 2)`` unit image gradients there."""
    p_c: FloatArray
    """``(E, 3)``"""
    sigma: FloatArray
    """``(E,)`` standard deviation of the depth [map units]."""
    colour: NDArray[np.uint8]
    observations: IntArray
    """``(E,)`` keyframes that measured the same point, this one included."""
    keypoint_z: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(N,)`` depths of the keyframe's keypoints when its edges were measured, NaN without a triangulated anchor;
    empty if unknown."""

    def grow(self, scale: float) -> None:
        """Multiply all depths."""
        self.p_c *= scale
        self.sigma *= scale
        self.keypoint_z *= scale

    def keep(self, mask: NDArray[np.bool_]) -> int:
        """Remove the points outside a mask ``(E,)``; returns their number."""
        for name in ("uv", "normal", "p_c", "sigma", "colour", "observations"):
            setattr(self, name, getattr(self, name)[mask])
        return int((~mask).sum())


class EdgeMap:
    """Measures and stores the edges of keyframes; modified under the map's lock only."""

    def __init__(self, slam_map: SlamMap, camera: Camera, config: EdgeConfig) -> None:
        self.map = slam_map
        self.camera = camera
        self.config = config
        self.hosts: list[EdgePoints] = []
        self._waiting: list[int] = []

    def announce(self, keyframe: Keyframe) -> None:
        """Queue a keyframe; its edges are measured once enough others have followed."""
        self._waiting.append(keyframe.id)

    def update(self, everything: bool = False) -> None:
        """Measure the keyframes that are due, or all of them."""
        keep = 0 if everything else DELAY_KEYFRAMES
        while len(self._waiting) > keep:
            keyframe = self.map.keyframes.get(self._waiting.pop(0))
            if keyframe is not None:  # it may have been culled meanwhile
                self._measure(keyframe)
                # The grey image is kept for other keyframes' edges; the rest (3 MB) is released.
                keyframe.image = keyframe.depth = None

    def _measure(self, keyframe: Keyframe) -> None:
        if keyframe.image is None:
            return
        edges = extract_edges(keyframe.image, self.config.canny_low, self.config.canny_high, self.config.max_pixels)
        points, _ = self._measured(keyframe, edges.uv, edges.normal, edges.colour)
        if points is not None:
            self.add(points)

    def _measured(
        self, keyframe: Keyframe, uv: FloatArray, normal: FloatArray, colour: NDArray[np.uint8]
    ) -> tuple[EdgePoints | None, IntArray]:
        """Edges of a keyframe with measurable depth, and their indices; None without another view of them."""
        targets = self._targets(keyframe)
        if not targets or keyframe.grey is None:
            return None, np.zeros(0, dtype=np.int64)
        prior, sigma = self._prior(keyframe, uv)
        known = np.isfinite(prior)
        uv, normal = uv[known], normal[known]
        measured = measure_edge_depth(
            StereoView(keyframe.grey, keyframe.T_c_w),
            uv,
            normal,
            prior[known],
            sigma[known],
            [StereoView(t.grey, t.T_c_w) for t in targets if t.grey is not None],
            self.camera,
        )
        depth = 1.0 / measured.inverse_depth
        relative = measured.sigma * depth
        good = np.isfinite(depth) & (depth > 0) & (relative < self.config.max_sigma)
        points = EdgePoints(
            keyframe_id=keyframe.id,
            uv=uv[good],
            normal=normal[good],
            p_c=self.camera.back_project(uv[good], depth[good]),
            sigma=(relative * depth)[good],
            colour=colour[known][good],
            observations=np.ones(int(good.sum()), dtype=np.int32),
            keypoint_z=self._keypoint_z(keyframe),
        )
        return points, np.flatnonzero(known)[good]

    def _keypoint_z(self, keyframe: Keyframe) -> FloatArray:
        """Depth ``(N,)`` of a keyframe's triangulated anchors at their keypoints, NaN elsewhere."""
        with_anchor = keyframe.keypoints_with_anchor()
        triangulated = ~self.map.anchors.from_depth[keyframe.anchor[with_anchor]]
        with_anchor = with_anchor[triangulated]
        z = np.full(len(keyframe.anchor), np.nan)
        z[with_anchor] = se3.transform(keyframe.T_c_w, self.map.anchors.p_w[keyframe.anchor[with_anchor]])[:, 2]
        z[z <= 0] = np.nan
        return z

    def follow_anchors(self) -> None:
        """Scale the depths of each keyframe's edges as refinement has scaled the depths of its anchors.

        They were measured with the poses of their time. A refinement that changes the scale of a place moves anchors
        and poses, and edges that stay behind pull the poses back in the next one. Where more than
        a scale has changed, they are measured again.
        """
        for i, host in enumerate(self.hosts):
            keyframe = self.map.keyframes.get(host.keyframe_id)
            if keyframe is None or len(host.keypoint_z) != len(keyframe.anchor):
                continue
            now = self._keypoint_z(keyframe)
            change = np.log(now / host.keypoint_z)
            change = change[np.isfinite(change)]
            if len(change) >= MIN_ANCHORS:
                host.grow(math.exp(float(np.median(change))))
                host.keypoint_z = now
            if self._is_off(host, keyframe):
                self.hosts[i] = self._measured_again(host, keyframe)

    def _measured_again(self, host: EdgePoints, keyframe: Keyframe) -> EdgePoints:
        """A keyframe's edges, measured again with the current poses."""
        again, _ = self._measured(keyframe, host.uv, host.normal, host.colour)
        if again is None:
            return host
        for mine, _ in self._agreeing(again, self._overlapping(keyframe, [h for h in self.hosts if h is not host])):
            again.observations[mine] += 1
        return again

    def _is_off(self, host: EdgePoints, keyframe: Keyframe) -> bool:
        """Whether a sample of a keyframe's edges, measured with the current poses, has other depths."""
        some = np.arange(0, len(host.uv), max(1, len(host.uv) // CHECKED))
        again, which = self._measured(keyframe, host.uv[some], host.normal[some], host.colour[some])
        if again is None or len(which) < MIN_ANCHORS:
            return False
        change = np.log(again.p_c[:, 2] / host.p_c[some[which], 2])
        return abs(float(np.median(change))) > OFF_LOG

    def add(self, points: EdgePoints) -> None:
        """Add the measured edges of a keyframe; remove others above the limit."""
        with self.map.lock:
            others = self._overlapping(self.map.keyframes[points.keyframe_id], self.hosts[-RECENT_HOSTS:])
            for other, (mine, theirs) in zip(others, self._agreeing(points, others), strict=True):
                points.observations[mine] += 1
                other.observations[theirs] += 1
            self.hosts.append(points)
            self._bound()

    def _prior(self, keyframe: Keyframe, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected depth and its log sigma ``(E,)`` at edges, shared within a cell, to reduce queries."""
        across = -(-self.camera.width // PRIOR_CELL_PX)
        u, v = (uv // PRIOR_CELL_PX).astype(np.int64).T
        cells, cell_of = np.unique(v * across + u, return_inverse=True)
        middle = np.stack([cells % across, cells // across], axis=1) * PRIOR_CELL_PX + (PRIOR_CELL_PX - 1) / 2
        prior, sigma = depth_prior(keyframe, middle, self.map.anchors)
        return prior[cell_of], sigma[cell_of]

    def _bound(self) -> None:
        """Keep to ``max_points``: first remove old points of a single keyframe, then half of the oldest."""
        total = sum(len(h.uv) for h in self.hosts)
        if total <= self.config.max_points:
            return
        for host in self.hosts[:-RECENT_HOSTS]:
            total -= host.keep(host.observations >= self.config.min_observations)
        while total > self.config.max_points:
            for host in self.hosts:
                total -= host.keep(
                    np.arange(len(host.uv)) % 2 == 0 if len(host.uv) > 1 else np.zeros(len(host.uv), bool)
                )
                if total <= self.config.max_points:
                    return

    def _targets(self, keyframe: Keyframe) -> list[Keyframe]:
        """Covisible keyframes whose baseline is long enough for parallax and short enough for similar appearance."""
        depth = self.map.median_depth(keyframe) or 1.0
        chosen = []
        for other in self.map.covisible(keyframe, 4 * TARGETS, min_shared=30):
            baseline = float(np.linalg.norm(other.centre_w - keyframe.centre_w)) / depth
            if other.grey is not None and 0.02 < baseline < 0.5:
                chosen.append(other)
        return chosen[:TARGETS]

    def _overlapping(self, keyframe: Keyframe, hosts: list[EdgePoints]) -> list[EdgePoints]:
        near = {k.id for k in self.map.covisible(keyframe, 3 * TARGETS)}
        return [h for h in hosts if h.keyframe_id in near][-8:]

    def _agreeing(self, points: EdgePoints, others: list[EdgePoints]) -> Iterator[tuple[IntArray, IntArray]]:
        """Indices of points with consistent depth in a keyframe and in each of others: the cycle of paper eqs.
        (17)-(22), as a test."""
        painted = PaintedEdges.of(points.uv, (self.camera.width, self.camera.height))
        T_p_w = self.map.pose_of(points.keyframe_id)
        for other in others:
            p = se3.transform(T_p_w @ self._T_w_c(other), other.p_c)
            front = np.flatnonzero(p[:, 2] > 0)
            nearest = painted.nearest(self.camera.project(p[front]))
            found = nearest >= 0
            mine, theirs = nearest[found], front[found]
            z_mine = points.p_c[mine, 2]
            same = np.abs(p[theirs, 2] - z_mine) < AGREE_DEPTH * z_mine
            yield np.unique(mine[same]), theirs[same]

    def points(self, piece: int | None = None) -> PointCloud:
        """Edge points that several keyframes agree on, fused in cells, in the map's world frame.

        A consistent snapshot, callable from any thread.

        Args:
            piece: Number of the submap; None for all.
        """
        with self.map.lock:  # the arrays are copies from here on
            hosts = [h for h in self.hosts if piece is None or self.map.piece_of(h.keyframe_id) == piece]
            if not any(len(h.uv) for h in hosts):
                empty = np.zeros((0, 3), np.float32)
                return PointCloud(empty, np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.int32))
            views = [View(self._T_w_c(h), h.uv.copy(), h.p_c.copy()) for h in hosts]
            sigma = np.concatenate([h.sigma for h in hosts])
            colour = np.concatenate([h.colour for h in hosts])
            count = np.concatenate([h.observations for h in hosts])
        p_w = np.concatenate([se3.transform(v.T_w_c, v.p_c) for v in views])
        z = np.concatenate([v.p_c[:, 2] for v in views])
        depth = np.median(z)
        sigma = np.hypot(sigma, bend(views, self.camera) * z)
        agreed = count >= self.config.min_observations
        return fuse_voxels(p_w[agreed], sigma[agreed], colour[agreed], count[agreed], self.config.voxel * float(depth))

    def around(self, keyframe: Keyframe) -> FloatArray:
        """Edge points ``(E, 3)`` in the map's world that several of a keyframe's covisible keyframes agree on.

        A consistent snapshot, callable from any thread, at a fraction of the cost of all `points`. The relative
        standard deviation of their depth is at most `NEARLY`.
        """
        with self.map.lock:
            same = [h for h in self.hosts if h.keyframe_id == keyframe.id]
            hosts = same + [h for h in self._overlapping(keyframe, self.hosts) if h.keyframe_id != keyframe.id]
            parts: list[FloatArray] = [np.zeros((0, 3))]
            for host in hosts:
                sure = host.sigma < NEARLY * host.p_c[:, 2]
                agreed = host.observations >= self.config.min_observations
                parts.append(se3.transform(self._T_w_c(host), host.p_c[sure & agreed]))
        return np.concatenate(parts)

    def _T_w_c(self, host: EdgePoints) -> FloatArray:
        return se3.inverse(self.map.pose_of(host.keyframe_id))


def fuse_voxels(
    p_w: FloatArray, sigma: FloatArray, colour: NDArray[np.uint8], count: IntArray, voxel: float
) -> PointCloud:
    """One point per occupied cell: the inverse-variance mean of its points."""
    if len(p_w) == 0:
        return PointCloud(p_w.astype(np.float32), colour, sigma.astype(np.float32), count.astype(np.int32))
    cell = np.floor(p_w / voxel).astype(np.int64)
    cell -= cell.min(axis=0)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, group, size = np.unique(key, return_inverse=True, return_counts=True)
    weight = 1.0 / np.maximum(sigma, 1e-9) ** 2
    total = np.bincount(group, weight)
    mean = np.stack([np.bincount(group, weight * p_w[:, i]) / total for i in range(3)], axis=1)
    rgb = np.stack([np.bincount(group, weight * colour[:, i]) / total for i in range(3)], axis=1)
    most = np.zeros(len(size), dtype=np.int64)
    np.maximum.at(most, group, count)
    # Errors within a cell are correlated through the poses: take the smallest sigma, not the sum of informations.
    best = np.full(len(size), np.inf)
    np.minimum.at(best, group, sigma)
    return PointCloud(
        mean.astype(np.float32), np.rint(rgb).astype(np.uint8), best.astype(np.float32), most.astype(np.int32)
    )
