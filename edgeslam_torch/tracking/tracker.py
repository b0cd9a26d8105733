"""The pose of one frame against the local map, not against the previous frame, which would accumulate drift."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.config import OrbConfig, TrackingConfig
from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import Matches, words
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.projection import Projection, match_projection, project_anchors
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.optim.pose_only import PoseConfig
from edgeslam_torch.tracking.pose_prior import ExpectedPose, pose_on_anchors
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

ROUGH = PoseConfig(rounds=1, robust_rounds=1, iterations=5, cost_tolerance=1e-2)
"""The first pass only brings the local map's anchors into their search radius."""

ENOUGH_FOR_ROUGH = 250
"""Maximum number of the last frame's anchors in the first pass; more do not improve it."""

FINE = PoseConfig(rounds=3, robust_rounds=1, cost_tolerance=1e-2)
"""The pass on all matches; its tolerance is 0.1 standard deviations: less than the frame's own noise."""

MOTION_RADIUS_PX = 15.0
"""Search radius around the predicted pixel, at pyramid level 0: 1.6 degrees at 525 px."""
WIDER = 2.5
"""Factor on the radius of a second search: 37 instead of 15 px, 4 degrees at 525 px, a rotation of 120 degrees a second
at 30 Hz."""
MAP_RADIUS_PX = 5.0
"""Search radius for the local map once the pose is known from the first pass."""
LOCAL_KEYFRAMES = 30
"""Maximum number of keyframes in the local map."""
MIN_ROUGH = 10
"""Inliers of a rough pose from which the local map is searched: 20 equations for 6 unknowns. `min_inliers` decides
after that search."""


@dataclass(frozen=True, slots=True)
class View:
    """Features of one frame, indexed for matching."""

    features: FrameFeatures
    words: NDArray[np.uint64]
    grid: KeypointGrid
    inv_sigma: FloatArray
    """``(N,)`` inverse standard deviation of each keypoint [1/px], from its pyramid level."""


@dataclass(frozen=True, slots=True)
class Track:
    """A pose with its matches."""

    T_c_w: FloatArray
    keypoint: IntArray
    """``(M,)`` inlier keypoints."""
    anchor: IntArray
    """``(M,)`` their anchors."""
    matched_keypoint: IntArray
    matched_anchor: IntArray
    """All matches, including outliers."""
    covariance: FloatArray
    """``(6, 6)`` of the left tangent of ``T_c_w``."""

    @property
    def matches(self) -> int:
        """Number of matches, including outliers."""
        return len(self.matched_anchor)

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return len(self.anchor)


def make_view(features: FrameFeatures, scale_factor: float) -> View:
    """Index a frame's features for matching."""
    return View(
        features=features,
        words=words(features.descriptors),
        grid=KeypointGrid(features.uv),
        inv_sigma=scale_factor ** -features.octave.astype(np.float64),
    )


class Tracker:
    """Matches anchors in a frame and refines its pose; stateless."""

    def __init__(self, slam_map: SlamMap, camera: Camera, orb: OrbConfig, config: TrackingConfig) -> None:
        self.map = slam_map
        self.camera = camera
        self.orb = orb
        self.config = config

    def track(
        self, view: View, T_c_w: FloatArray, recent: IntArray, expected: ExpectedPose | None = None
    ) -> Track | None:
        """Pose near a predicted one: anchors of the last frame first, then the local map; None with too few
        inliers."""
        some = recent[:: 1 + len(recent) // ENOUGH_FOR_ROUGH]
        first = self.refine(view, T_c_w, some, MOTION_RADIUS_PX, ROUGH, expected)
        if first is None or first.inliers < self.config.min_inliers:
            first = self.refine(view, T_c_w, recent, WIDER * MOTION_RADIUS_PX, ROUGH, expected)
        if first is None or first.inliers < MIN_ROUGH:
            return None
        return self._complete(view, first.T_c_w, first.anchor, first.keypoint, first.anchor, expected)

    def track_near(
        self, view: View, T_c_w: FloatArray, recent: IntArray, expected: ExpectedPose | None = None
    ) -> Track | None:
        """The same from a pose accurate to a pixel or two, without the first pass."""
        return self._complete(view, T_c_w, recent, recent[:0], recent[:0], expected)

    def local_keyframes(self, anchor_ids: IntArray) -> list[Keyframe]:
        """Keyframes that observe most of the given anchors."""
        counts = self.map.shared_counts(anchor_ids)
        ranked = sorted(counts, key=lambda id: (-counts[id], -id))
        return [self.map.keyframes[id] for id in ranked[:LOCAL_KEYFRAMES]]

    def refine(
        self,
        view: View,
        T_c_w: FloatArray,
        anchor_ids: IntArray,
        radius_px: float,
        effort: PoseConfig = FINE,
        expected: ExpectedPose | None = None,
    ) -> Track | None:
        """Match the given anchors around their predicted pixels and refine the pose on the matches."""
        seen = self.expected(T_c_w, anchor_ids)
        matches = self._match(view, seen, np.full(len(seen.anchor), radius_px))
        return self.solve(view, T_c_w, matches.train, seen.anchor[matches.query], effort, expected)

    def _complete(
        self,
        view: View,
        T_c_w: FloatArray,
        recent: IntArray,
        keypoint: IntArray,
        anchor: IntArray,
        expected: ExpectedPose | None,
    ) -> Track | None:
        """Track against the local map around ``recent``; known matches are kept."""
        anchors = self.map.anchors
        seen = self.expected(T_c_w, self.map.anchors_seen_by(self.local_keyframes(recent)))
        new = seen.select(~np.isin(seen.anchor, anchor))
        radius = MAP_RADIUS_PX * self.orb.scale_factor ** new.octave.astype(np.float64)
        matches = self._match(view, new, radius)
        free = ~np.isin(matches.train, keypoint)
        keypoint = np.concatenate([keypoint, matches.train[free]])
        anchor = np.concatenate([anchor, new.anchor[matches.query[free]]])
        track = self.solve(view, T_c_w, keypoint, anchor, FINE, expected)
        if track is None:
            return None
        anchors.visible[seen.anchor] += 1
        anchors.found[track.anchor] += 1
        return track if track.inliers >= self.config.min_inliers else None

    def expected(self, T_c_w: FloatArray, anchor_ids: IntArray) -> Projection:
        """Projection of the given anchors, those in view."""
        anchors = self.map.anchors
        ids = anchor_ids[anchors.alive[anchor_ids]]
        return project_anchors(anchors, ids, T_c_w, self.camera, self.orb.scale_factor, self.orb.levels)

    def _match(self, view: View, seen: Projection, radius_px: FloatArray) -> Matches:
        return match_projection(
            seen,
            self.map.anchors.words[seen.anchor],
            view.words,
            view.features.octave,
            view.grid,
            radius_px,
        )

    def solve(
        self,
        view: View,
        T_c_w: FloatArray,
        keypoint: IntArray,
        anchor: IntArray,
        effort: PoseConfig = FINE,
        expected: ExpectedPose | None = None,
    ) -> Track | None:
        """Robust pose from given matches; None with too few of them."""
        if len(keypoint) < 6:
            return None
        uv, inv_sigma = view.features.uv[keypoint].astype(np.float64), view.inv_sigma[keypoint]
        result = pose_on_anchors(self.map.anchors, anchor, uv, inv_sigma, T_c_w, self.camera, expected, effort)
        return Track(
            T_c_w=result.T_c_w,
            keypoint=keypoint[result.inliers],
            anchor=anchor[result.inliers],
            matched_keypoint=keypoint,
            matched_anchor=anchor,
            covariance=result.covariance,
        )


def parallax_to(reference: Keyframe, track: Track, p_w: FloatArray) -> float:
    """Median angle [rad] at the anchors ``p_w`` ``(A, 3)`` of a track between its camera and a keyframe."""
    return median_parallax(p_w[track.anchor], track.T_c_w, reference.centre_w)


def median_parallax(p_w: FloatArray, T_c_w: FloatArray, centre_w: FloatArray) -> float:
    """Median angle [rad] between the rays from two camera centres to points ``(N, 3)``; 0 without points."""
    if len(p_w) == 0:
        return 0.0
    a = p_w + T_c_w[:3, :3].T @ T_c_w[:3, 3]
    b = p_w - centre_w
    dot, aa, bb = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (a, a), (b, b)))
    cosine = float(np.median(dot / np.maximum(np.sqrt(aa * bb), 1e-12)))  # the angle is monotonic in the cosine
    return math.acos(min(max(cosine, -1.0), 1.0))
