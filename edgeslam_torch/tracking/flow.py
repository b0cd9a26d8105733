"""Tracking between keyframes: optical flow of the last keyframe's keypoints, and the pose from it.

A frame between keyframes contributes only its pose, for which corners need not be detected, described and matched:
pyramidal Lucas-Kanade flow (Lucas and Kanade, IJCAI 1981; Bouguet, 2001) tracks the known ones in a quarter of the
time. It goes from the keyframe to the frame, never from frame to frame, to avoid drift.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.config import FlowConfig, OrbConfig
from edgeslam_torch.frontend.keypoint_grid import nearest_pixels
from edgeslam_torch.frontend.orb import spread
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.tracking.pose_prior import ExpectedPose, pose_on_anchors
from edgeslam_torch.tracking.tracker import FINE, Track, View
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray

MAX_DIFFERENCE = 30.0
"""Maximum mean grey difference of corresponding patches."""

MIN_DEPTH = 1e-3
"""Minimum depth of a tracked anchor [map units]."""

JOIN_PX = 1.5
"""Maximum distance between a keypoint and a tracked anchor that are the same, at pyramid level 0."""

MIN_SHARE = 0.4
"""Minimum share of tracked keypoints; below, descriptors are matched first. Below this share of those in view, the
pose from flow is rejected."""

WINDOW_PX = 15
"""Side of the tracked patch."""

LEVELS = 4
"""Pyramid levels, each half the size of the previous one."""

NEAR_LEVELS = 2
"""Pyramid levels that suffice for predictions within 14 pixels, at half the time of four."""

NEAR_SHARE = 0.75
"""Below this share of the chosen keypoints, all pyramid levels are tried as well. By the share of those in view they
would be tried less often in big steps, where they make the pose more accurate."""

_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.03)
"""Termination: steps and pixels per step; at 0.1 px the result is biased towards the prediction."""


@dataclass(frozen=True, slots=True)
class Template:
    """An image with anchors, tracked into the following frames."""

    keyframe_id: int
    """Reference keyframe of the frames' poses."""
    grey: NDArray[np.uint8]
    """``(H, W)`` with the lens distortion still in it."""
    uv: FloatArray
    """``(N, 2)`` undistorted pixels of the keypoints, float32; a keyframe's own array, which mapping aligns."""
    octave: IntArray
    """``(N,)``"""
    anchor: IntArray
    """``(N,)`` or `NO_ANCHOR`; a keyframe's own array, so that anchors added by mapping are tracked too."""


@dataclass(frozen=True, slots=True)
class _Chosen:
    """Selected keypoints of a template, valid while template and observations are unchanged."""

    template: Template | None
    revision: int
    keypoint: IntArray


@dataclass(frozen=True, slots=True)
class Followed:
    """Result of optical flow in a frame."""

    keyframe_id: int
    """Reference keyframe of the pose."""
    track: Track
    """Pose and matches; keypoint indices are the template's."""
    uv: FloatArray
    """``(M, 2)`` undistorted pixels of the track's inliers in the frame."""
    octave: IntArray
    """``(M,)`` their pyramid levels."""
    share: float
    """Share of inliers among the selected keypoints."""
    trusted: bool
    """Whether enough of those in view are inliers for a pose; otherwise it is only a prediction."""


def template_of_keyframe(keyframe: Keyframe, grey: NDArray[np.uint8]) -> Template:
    """Template of a keyframe's anchors; ``grey`` is its distorted image."""
    return _template(keyframe.id, keyframe.features, keyframe.anchor, grey)


def template_of_track(track: Track, view: View, reference: Keyframe, grey: NDArray[np.uint8]) -> Template:
    """Template of the anchors matched in a frame that is not a keyframe."""
    anchor = np.full(len(view.features.uv), NO_ANCHOR, dtype=np.int64)
    anchor[track.keypoint] = track.anchor
    return _template(reference.id, view.features, anchor, grey)


def _template(keyframe_id: int, features: FrameFeatures, anchor: IntArray, grey: NDArray[np.uint8]) -> Template:
    return Template(keyframe_id, grey, features.uv, features.octave, anchor)


def join(track: Track, followed: Followed, view: View, scale_factor: float) -> Track:
    """Extend a matched track by anchors that only flow found, on free keypoints.

    Descriptors match every second corner from keyframe to keyframe. Flow's own pixels are not used as observations,
    because they drift in one direction; detected corners do not.
    """
    free = np.setdiff1d(np.arange(len(view.features.uv)), track.keypoint)
    missing = ~np.isin(followed.track.anchor, track.anchor)
    if len(free) == 0:
        return track
    anchor, octave = followed.track.anchor[missing], followed.octave[missing]
    distance, nearest = nearest_pixels(view.features.uv[free], followed.uv[missing], 1)
    distance, keypoint = distance[:, 0], free[nearest[:, 0]]
    near = distance < JOIN_PX * scale_factor**octave
    near &= np.abs(view.features.octave[keypoint] - octave) <= 1
    best_first = np.flatnonzero(near)[np.argsort(distance[near], kind="stable")]
    keypoint, first = np.unique(keypoint[best_first], return_index=True)
    anchor = anchor[best_first][first]
    return replace(
        track,
        keypoint=np.concatenate([track.keypoint, keypoint]),
        anchor=np.concatenate([track.anchor, anchor]),
        matched_keypoint=np.concatenate([track.matched_keypoint, keypoint]),
        matched_anchor=np.concatenate([track.matched_anchor, anchor]),
    )


def with_followed(view: View, followed: Followed, words: NDArray[np.uint64]) -> tuple[FrameFeatures, Track]:
    """A frame's features with flow's pixels after them, and flow's track on these.

    For a frame that must become a keyframe although none of its corners matches: the strongest corners have just come
    into view, and the detector's limit excludes the weaker ones that flow still tracks. Flow drifts slightly, but
    without these observations the new corners have no connection to the map.

    Args:
        view: The frame's features.
        followed: What flow tracks into it.
        words: Descriptors ``(A, 4)`` of all anchors, by id.
    """
    features, track, count = view.features, followed.track, len(view.features.uv)
    descriptors = np.ascontiguousarray(words[track.anchor]).view(np.uint8).reshape(-1, features.descriptors.shape[1])
    features = replace(
        features,
        uv=np.concatenate([features.uv, followed.uv.astype(features.uv.dtype)]),
        octave=np.concatenate([features.octave, followed.octave.astype(features.octave.dtype)]),
        angle_rad=np.concatenate([features.angle_rad, np.zeros(track.inliers, features.angle_rad.dtype)]),
        descriptors=np.concatenate([features.descriptors, descriptors]),
    )
    keypoint = count + np.arange(track.inliers)
    return features, replace(track, keypoint=keypoint, matched_keypoint=keypoint, matched_anchor=track.anchor)


class FlowTracker:
    """Tracks a template's anchors into a frame and refines its pose; caches the selected keypoints."""

    def __init__(self, slam_map: SlamMap, camera: Camera, orb: OrbConfig, config: FlowConfig, min_inliers: int) -> None:
        self.map = slam_map
        self.camera = camera
        self.orb = orb
        self.config = config
        self.min_inliers = min_inliers
        self._chosen = _Chosen(None, -1, np.zeros(0, dtype=np.int64))

    def follow(
        self, template: Template, grey: NDArray[np.uint8], T_c_w: FloatArray, expected: ExpectedPose | None = None
    ) -> Followed | None:
        """Pose near a predicted one, or None if hardly any keypoint is tracked.

        Args:
            template: Template to track.
            grey: Frame ``(H, W)`` with the lens distortion still in it.
            T_c_w: Predicted pose ``(4, 4)``.
            expected: The pose as predicted.
        """
        wanted = self._wanted(template)
        guess = self._expected(T_c_w, template.anchor[wanted])
        in_view = np.isfinite(guess).all(axis=1)
        visible, guess = wanted[in_view], guess[in_view]
        if len(visible) < self.min_inliers:
            return None
        least = max(self.min_inliers, MIN_SHARE * len(visible))
        track, uv = self._locate(template, grey, visible, guess, T_c_w, NEAR_LEVELS, expected)
        if track.inliers < NEAR_SHARE * len(wanted):
            far = self._locate(template, grey, visible, guess, T_c_w, LEVELS, expected)
            # Patches of coarse levels extend beyond the image: keypoints near its border are found on fine levels.
            track, uv = far if far[0].inliers >= least else max(far, (track, uv), key=lambda tried: tried[0].inliers)
        if track.inliers < self.min_inliers:
            return None
        trusted = track.inliers >= least
        if trusted:
            self.map.anchors.visible[template.anchor[visible]] += 1
            self.map.anchors.found[track.anchor] += 1
        octave = template.octave[track.keypoint]
        return Followed(template.keyframe_id, track, uv, octave, track.inliers / len(wanted), trusted)

    def _locate(
        self,
        template: Template,
        grey: NDArray[np.uint8],
        keypoint: IntArray,
        guess: FloatArray,
        T_c_w: FloatArray,
        levels: int,
        expected: ExpectedPose | None,
    ) -> tuple[Track, FloatArray]:
        """Pose from flow over the given pyramid levels, and the inliers' undistorted pixels."""
        raw_uv, found = self._flow(template, grey, keypoint, guess, levels)
        keypoint, uv = keypoint[found], self.camera.undistort_points(raw_uv[found])
        track = self._solve(template, keypoint, uv, T_c_w, expected)
        return track, uv[np.isin(keypoint, track.keypoint)]

    def _wanted(self, template: Template) -> IntArray:
        """Keypoints to track: evenly spread, preferring those with most observations."""
        if self._chosen.template is template and self._chosen.revision == self.map.revision:
            return self._chosen.keypoint
        anchors = self.map.anchors
        observed = np.flatnonzero(template.anchor >= 0)
        observed = observed[anchors.alive[template.anchor[observed]]]
        seen_by = anchors.observations[template.anchor[observed]].astype(np.float64)
        some = spread(template.uv[observed], seen_by, self.camera.width, self.camera.height, self.config.points)
        self._chosen = _Chosen(template, self.map.revision, observed[some])
        return self._chosen.keypoint

    def _expected(self, T_c_w: FloatArray, anchor: IntArray) -> FloatArray:
        """Predicted pixels ``(M, 2)`` in the distorted image, NaN outside of it."""
        p_c = se3.transform(T_c_w, self.map.anchors.p_w[anchor])
        front = p_c[:, 2] > MIN_DEPTH
        p_c[~front] = 1.0
        uv = self.camera.project_through_lens(p_c)
        u, v = uv.T
        outside = ~front | (u <= 0) | (v <= 0) | (u >= self.camera.width) | (v >= self.camera.height)
        uv[outside] = np.nan
        return uv

    def _flow(
        self, template: Template, grey: NDArray[np.uint8], keypoint: IntArray, guess: FloatArray, levels: int
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Distorted pixels ``(M, 2)`` of the template's keypoints in the frame, and which of them were found."""
        uv, status, difference = cv2.calcOpticalFlowPyrLK(
            template.grey,
            grey,
            np.ascontiguousarray(self.camera.distort_points(template.uv[keypoint]), np.float32).reshape(-1, 1, 2),
            np.ascontiguousarray(guess, dtype=np.float32).reshape(-1, 1, 2),
            winSize=(WINDOW_PX, WINDOW_PX),
            maxLevel=levels - 1,
            criteria=_STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        found = (status.ravel() > 0) & (difference.ravel() < MAX_DIFFERENCE)
        return np.asarray(uv, dtype=np.float32).reshape(-1, 2), found

    def _solve(
        self, template: Template, keypoint: IntArray, uv: FloatArray, T_c_w: FloatArray, expected: ExpectedPose | None
    ) -> Track:
        # Flow inherits the localisation error of the keyframe's keypoint: same weight as a match.
        anchor = template.anchor[keypoint]
        inv_sigma = self.orb.scale_factor ** -template.octave[keypoint].astype(np.float64)
        found = uv.astype(np.float64)
        result = pose_on_anchors(self.map.anchors, anchor, found, inv_sigma, T_c_w, self.camera, expected, FINE)
        inliers = result.inliers
        return Track(result.T_c_w, keypoint[inliers], anchor[inliers], keypoint, anchor, result.covariance)
