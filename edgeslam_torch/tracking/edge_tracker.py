"""The pose of a frame from edges, used where corners are few.

An edge pixel constrains the pose across the edge but not along it. Edge points of nearby keyframes are projected into
the frame and associated with the nearest Canny pixel; `refine_pose` gets a large slack along the edge. Points, if any,
are used as well. REVO (Schenk and Fraundorfer, ICRA 2017) and the edgelets of SVO use the same distance.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.frontend.canny import canny_of_gradient, edge_thresholds, gradient
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.optim.pose_only import MIN_POINTS, PoseConfig, PoseResult, refine_pose
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray, IntArray

HOSTS = 5
"""Number of keyframes whose edges are used: the nearest in position and direction."""
POINTS = 600
"""Maximum number of edge points, evenly thinned."""
SIGMA_PX = 2.0
"""Sigma across the edge: edges scatter by 0.8 px, but errors of neighbours are correlated: six count as one."""
ALONG_PX = 1e3
"""Slack along the edge, which is unconstrained."""
REACH_PX = (12.0, 4.0, 4.0)
"""Association distance in each round; larger for the prediction than for its refinements."""
AGREE_PX = 1.5
"""Maximum distance across the edge of an inlier: two sigmas of a single edge pixel."""
SAME_SIDE_COS = np.cos(np.deg2rad(30.0))
"""Minimum cosine between the normals of a projected edge and its partner (30 degrees). In a cluttered image, one
point in ten has such an edge by chance."""
MIN_EDGES = 80
"""Minimum number of inliers for a pose from edges alone."""
MIN_SHARE = 0.7
"""Minimum share of inliers among edge points in view, for a pose from edges alone."""
MAX_SIGMA = 0.05
"""Maximum sigma of position relative to depth, and of rotation [rad] (3 degrees), for a pose from edges alone:
parallel lines leave one direction unconstrained."""
EFFORT = PoseConfig(rounds=2, robust_rounds=1, cost_tolerance=1e-3)


@dataclass(frozen=True, slots=True)
class PointsInFrame:
    """Points with their pixels in the frame, ``M`` of them."""

    p_w: FloatArray
    """``(M, 3)``"""
    uv: FloatArray
    """``(M, 2)`` undistorted pixels."""
    inv_sigma: FloatArray
    """``(M,)`` [1/px]."""
    slack_px: FloatArray
    """``(M, 2)`` see `refine_pose`."""

    @classmethod
    def none(cls) -> "PointsInFrame":
        """Without points."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True)
class EdgePose:
    """A pose refined with edges."""

    T_c_w: FloatArray
    """``(4, 4)``"""
    covariance: FloatArray
    """``(6, 6)`` of its left tangent, from points and edges alone; NaN where they do not constrain it."""
    points: NDArray[np.bool_]
    """``(M,)`` inliers of the given points."""
    edges: int
    """Number of edge inliers."""
    in_view: int
    """Number of edge points in view."""
    depth: float
    """Median depth of these [map units]."""

    @property
    def is_fixed(self) -> bool:
        """Whether the edges alone constrain the pose."""
        if self.edges < max(MIN_EDGES, MIN_SHARE * self.in_view) or not np.isfinite(self.covariance).all():
            return False
        sigma = np.sqrt(np.diag(self.covariance))
        return bool(sigma[:3].max() < MAX_SIGMA * self.depth and sigma[3:].max() < MAX_SIGMA)


class EdgeTracker:
    """Tracks the edge map in a frame, if enabled; stateless."""

    def __init__(self, slam_map: SlamMap, edges: EdgeMap, camera: Camera, enabled: bool = True) -> None:
        self.map = slam_map
        self.edges = edges
        self.camera = camera
        self.enabled = enabled

    def refine(
        self,
        grey: NDArray[np.uint8],
        T_c_w: FloatArray,
        points: PointsInFrame | None = None,
        expected: PosePrior | None = None,
    ) -> EdgePose | None:
        """Pose near a predicted one from edges and points; None without measured edges or with too few inliers.

        Args:
            grey: Frame ``(H, W)`` with the lens distortion still in it.
            T_c_w: Predicted pose ``(4, 4)``.
            points: Anchors found in the frame.
            expected: Prior of the pose.
        """
        points = points or PointsInFrame.none()
        known = self._edges_near(T_c_w) if self.enabled else None
        if known is None:
            return None
        seen = EdgeImage.of(grey, self.edges.config.canny_low, self.edges.config.canny_high)
        if seen is None:
            return None
        count = len(points.uv)
        for reach in REACH_PX:
            edges, _ = self._match(seen, known, T_c_w, reach)
            if count + len(edges.uv) < MIN_POINTS:
                return None
            result = self._solve(T_c_w, points, edges, expected)
            T_c_w = result.T_c_w
        edges, in_view = self._match(seen, known, T_c_w, AGREE_PX)
        z = se3.transform(T_c_w, known.p_w)[:, 2]
        depth = float(np.median(z[z > 0])) if (z > 0).any() else 1.0
        covariance = result.covariance if expected is None else _without(expected, result.covariance)
        return EdgePose(T_c_w, covariance, result.inliers[:count], len(edges.uv), in_view, depth)

    def _solve(
        self, T_c_w: FloatArray, points: PointsInFrame, edges: PointsInFrame, expected: PosePrior | None
    ) -> PoseResult:
        camera = self.camera
        return refine_pose(
            T_c_w,
            np.concatenate([points.p_w, edges.p_w]),
            np.concatenate([points.uv, edges.uv]),
            np.concatenate([points.inv_sigma, edges.inv_sigma]),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            slack_px=np.concatenate([points.slack_px, edges.slack_px]),
            prior=expected,
            config=EFFORT,
        )

    def _edges_near(self, T_c_w: FloatArray) -> "KnownEdges | None":
        """Edges of nearby keyframes with their predicted normals."""
        hosts = {h.keyframe_id: h for h in self.edges.hosts if h.keyframe_id in self.map.keyframes and len(h.uv)}
        if not hosts:
            return None
        near = _nearest([self.map.keyframes[id] for id in hosts], T_c_w)
        p_w = np.concatenate([se3.transform(k.T_w_c, hosts[k.id].p_c) for k in near])
        turns = [(T_c_w[:3, :3] @ k.T_w_c[:3, :3])[:2, :2] for k in near]
        normal = np.concatenate([hosts[k.id].normal @ turn.T for k, turn in zip(near, turns, strict=True)])
        some = slice(None, None, 1 + len(p_w) // POINTS)
        length = np.maximum(np.linalg.norm(normal[some], axis=1, keepdims=True), 1e-9)
        return KnownEdges(p_w[some], normal[some] / length)

    def _match(
        self, seen: "EdgeImage", known: "KnownEdges", T_c_w: FloatArray, reach_px: float
    ) -> tuple[PointsInFrame, int]:
        """Edge points with their partners in the frame, and the number of edge points in view."""
        p_c = se3.transform(T_c_w, known.p_w)
        front = np.flatnonzero(p_c[:, 2] > 1e-3)
        uv = self.camera.project_through_lens(p_c[front])
        inside = seen.contains(uv)
        front, uv = front[inside], uv[inside]
        pixel, normal, near = seen.nearest(uv, reach_px)
        near &= np.einsum("ij,ij->i", normal, known.normal[front]) > SAME_SIDE_COS  # the same side must be bright
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        pixels = self.camera.undistort_points(pixel[near].astype(np.float32)).astype(np.float64)
        count = int(near.sum())
        found = PointsInFrame(known.p_w[front[near]], pixels, np.full(count, 1.0 / SIGMA_PX), ALONG_PX * tangent[near])
        return found, len(front)


@dataclass(frozen=True, slots=True)
class KnownEdges:
    """Edge points of the map, ``E`` of them."""

    p_w: FloatArray
    """``(E, 3)``"""
    normal: FloatArray
    """``(E, 2)`` unit gradients predicted in the frame."""


@dataclass(frozen=True, slots=True)
class EdgeImage:
    """Canny edges of a frame, with the nearest one of every pixel."""

    distance: FloatArray
    """``(H, W)`` to the nearest edge pixel [px]."""
    label: IntArray
    """``(H, W)`` index of the nearest edge pixel."""
    pixel: IntArray
    """``(L, 2)`` edge pixels."""
    normal: FloatArray
    """``(L, 2)`` unit gradients."""

    @classmethod
    def of(cls, grey: NDArray[np.uint8], low: float, high: float) -> "EdgeImage | None":
        """Edges of an image ``(H, W)``; None when it has none."""
        gx, gy = gradient(grey)
        mask = canny_of_gradient(gx, gy, *edge_thresholds(grey, low, high))
        if not mask.any():
            return None
        distance, label = cv2.distanceTransformWithLabels(
            (~mask).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        v, u = np.nonzero(mask)
        row = np.zeros(int(label.max()) + 1, dtype=np.int64)
        row[label[v, u]] = np.arange(len(u))
        normal = np.stack([gx[v, u], gy[v, u]], axis=1).astype(np.float64)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return cls(np.asarray(distance), row[label], np.stack([u, v], axis=1), normal)

    def contains(self, uv: FloatArray) -> NDArray[np.bool_]:
        """Which pixels ``(N, 2)`` lie inside, ``(N,)``."""
        height, width = self.distance.shape
        return (uv[:, 0] > 0) & (uv[:, 1] > 0) & (uv[:, 0] < width - 1) & (uv[:, 1] < height - 1)

    def nearest(self, uv: FloatArray, reach_px: float) -> tuple[IntArray, FloatArray, NDArray[np.bool_]]:
        """Nearest edge pixels ``(N, 2)`` with their normals ``(N, 2)``, and which are near enough ``(N,)``."""
        u, v = np.rint(uv).astype(np.int64).T
        row = self.label[v, u]
        return self.pixel[row], self.normal[row], self.distance[v, u] <= reach_px


def _without(prior: PosePrior, covariance: FloatArray) -> FloatArray:
    """Covariance ``(6, 6)`` of the measurements of a pose refined with a prior; NaN where they do not constrain it.

    Otherwise the prediction of every frame would pass for a measurement.
    """
    if np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh(np.linalg.inv(covariance) - prior.information)
        if values[0] > 0.0:
            return np.asarray((vectors / values) @ vectors.T)
    return np.full((6, 6), np.nan)


def _nearest(keyframes: list[Keyframe], T_c_w: FloatArray) -> list[Keyframe]:
    """The keyframes nearest in position and direction."""
    centre = -T_c_w[:3, :3].T @ T_c_w[:3, 3]
    turn = [np.arccos(np.clip(k.T_c_w[2, :3] @ T_c_w[2, :3], -1.0, 1.0)) for k in keyframes]
    distance = [float(np.linalg.norm(k.centre_w - centre)) for k in keyframes]
    scale = max(float(np.median(distance)), 1e-9)
    order = np.argsort(np.array(turn) + np.array(distance) / scale, kind="stable")
    return [keyframes[i] for i in order[:HOSTS]]
