"""Initialisation: track against predicted depths until two views with parallax replace them."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.config import InitialisationConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import Keyframe, make_keyframe, tracked_motion
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.prior_anchors import prior_of
from edgeslam_torch.mapping.refinement import Window, refine
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.tracking.initialiser import (
    MIN_POINTS,
    BootstrapView,
    Consensus,
    TwoView,
    consensus,
    poses_of_witnesses,
    two_view_map,
)
from edgeslam_torch.tracking.pose_prior import TrackingPrior
from edgeslam_torch.tracking.tracker import MOTION_RADIUS_PX, Track, Tracker, View
from edgeslam_torch.types import FloatArray, Frame, IntArray

logger = logging.getLogger(__name__)

MAX_DIRECTION_SIGMA_ALONE = 0.05
"""As `InitialisationConfig.max_direction_sigma`, 2.9 degrees, without a depth network: a small rotation and a small
translation move an image in nearly the same way, and only parallax, or predicted depth, resolves the ambiguity."""
WITNESS_SHARE = 0.6
"""Minimum share of inliers in the intermediate frames: correct structures reach 0.8 to 0.95 (95 % of correct
matches)."""

MAX_COST_RATIO = 1.2
"""Maximum ratio of the costs of two structures that both explain the images: four standard deviations of a chi-square
with several hundred degrees of freedom."""

OTHER_SAMPLES = 4
"""Further random samples of the matches that must agree on two views without confirmation by intermediate frames: if
every second sample disagrees, fifteen of sixteen such views are rejected."""

SAME_PICTURE_PX = 1.0
"""Median motion of the keypoints up to which a frame shows the reference's view. A static camera, or a repeated image,
matches all keypoints, which is no standard for later frames."""

AGREEING_SHARE = 0.8
"""The same after joint refinement of all frames: 95 % if every match were correct, less a sixth of wrong matches."""


@dataclass(frozen=True, slots=True)
class WaitingFrame:
    """A frame between the two views, which becomes a keyframe after initialisation."""

    frame: Frame
    view: View
    keypoint: IntArray
    """``(M,)`` matched keypoints of this frame."""
    reference_keypoint: IntArray
    """``(M,)`` their partners in the reference keyframe."""
    centre_w: FloatArray
    """``(3,)`` camera centre in the predicted map."""
    covariance: FloatArray
    """``(6, 6)`` of its pose in the predicted map."""


@dataclass(frozen=True, slots=True)
class StartedMap:
    """Result of initialisation."""

    new: list[tuple[Frame, Keyframe]]
    """Keyframes after the reference, in order; in the map, but not yet processed by mapping."""
    T_c_w: dict[int, FloatArray]
    """New poses of the reference and of the frames in between, by frame index."""


class Bootstrap:
    """Initialisation from a reference keyframe with predicted depths and the frames tracked against it."""

    def __init__(
        self,
        slam_map: SlamMap,
        tracker: Tracker,
        config: InitialisationConfig,
        reference: Keyframe,
        guess: FloatArray,
        colour: np.ndarray,
        seed: int = 0,
    ) -> None:
        """Start with a map of predicted depths.

        Args:
            slam_map: Map to which the reference and its anchors are added.
            tracker: Tracks them in the following frames.
            config: Thresholds.
            reference: First keyframe.
            guess: Depth of its keypoints [map units] and log standard deviation ``(N, 2)``.
            colour: RGB of its keypoints ``(N, 3)``.
            seed: Seed of the essential matrix's random samples.
        """
        self.map = slam_map
        self.tracker = tracker
        self.config = config
        self.seed = seed
        self.reference = reference
        self.guess_depth = guess_depth = guess[:, 0]
        self.max_matched = 0
        """Maximum number of inliers so far, of frames that differ from the reference."""
        self.views: list[BootstrapView] = []
        self.waiting: list[WaitingFrame] = []
        points = se3.transform(reference.T_w_c, tracker.camera.back_project(reference.features.uv, guess_depth))
        with slam_map.lock:
            slam_map.anchors.begin_pass()
            ids = slam_map.anchors.add(points, reference.words, reference.id, True, colour)
            slam_map.anchors.rest_on_prior(ids, reference.id, reference.centre_w, prior_of(*guess.T))
            reference.anchor[:] = ids
            slam_map.add_keyframe(reference)
            slam_map.refresh_anchors(ids)
        self._guessed = ids

    def forget_guess(self) -> None:
        """Remove the predicted anchors from the map; the caller removes the reference keyframe."""
        with self.map.lock:
            self.map.remove_anchors(self._guessed)

    def track(self, view: View, T_predicted: FloatArray, expected: TrackingPrior | None = None) -> Track | None:
        """Pose against the predicted map; the pose is rough, the matches are reliable."""
        radius = 2.0 * MOTION_RADIUS_PX
        track = self.tracker.refine(view, T_predicted, self._guessed, radius, expected=expected)
        if track is not None and self._moved_px(view, track) > SAME_PICTURE_PX:
            self.max_matched = max(self.max_matched, track.inliers)
        return track

    def _moved_px(self, view: View, track: Track) -> float:
        """Median displacement of matched keypoints relative to the reference [px]."""
        uv = self.reference.features.uv[self._reference_keypoints(track)]
        return float(np.median(np.linalg.norm(view.features.uv[track.matched_keypoint] - uv, axis=1)))

    def _reference_keypoints(self, track: Track) -> IntArray:
        """Keypoints of the reference that a frame was matched with ``(M,)``."""
        keypoint_of_anchor = np.full(len(self.map.anchors.alive), -1, dtype=np.int64)
        keypoint_of_anchor[self.reference.anchor] = np.arange(len(self.reference.anchor))
        return keypoint_of_anchor[track.matched_anchor]

    def two_views(self, frame_index: int, view: View, track: Track) -> TwoView:
        """Store the frame's matches and try to triangulate those of corners with the reference.

        Keypoints on edges slide along them (aperture problem): hundreds on a panelled wall fit an essential matrix of a
        wrong motion, with a sharp minimum.

        Args:
            frame_index: Index of the frame.
            view: Its features.
            track: Its matches.
        """
        reference_keypoint = self._reference_keypoints(track)
        self.views.append(
            BootstrapView(
                frame_index,
                view.features.uv[track.matched_keypoint],
                view.inv_sigma[track.matched_keypoint],
                reference_keypoint,
                track.T_c_w,
            )
        )
        keypoint = track.matched_keypoint
        both = self.reference.features.on_corners(reference_keypoint) & view.features.on_corners(keypoint)
        matches = reference_keypoint[both], keypoint[both]
        found = self._two_view_map(view, *matches, self.seed)
        if found.ok and len(self.views) == 1:
            others = (self._two_view_map(view, *matches, self.seed + k) for k in range(1, OTHER_SAMPLES + 1))
            if not all(other.ok and self._same_direction(found, other) for other in others):
                return replace(found, ok=False, reason="no frame between decides what random samples leave open")
        return found

    def _two_view_map(self, view: View, reference_keypoint: IntArray, keypoint: IntArray, seed: int) -> TwoView:
        camera, config = self.tracker.camera, self.config
        return two_view_map(self.reference, self.guess_depth, view, reference_keypoint, keypoint, camera, config, seed)

    def _same_direction(self, a: TwoView, b: TwoView) -> bool:
        """Whether two structures agree on the camera motion, within the allowed uncertainty of both directions."""
        one, other = (se3.inverse(two_view.T_c_w)[:3, 3] - self.reference.centre_w for two_view in (a, b))
        cosine = float(one @ other) / float(np.linalg.norm(one) * np.linalg.norm(other))
        return cosine > np.cos(np.sqrt(2.0) * self.config.max_direction_sigma)

    def confirm(self, view: View, two_view: TwoView) -> TwoView:
        """The structure refined over all frames, or rejected with a reason."""
        points = np.full((len(self.reference.anchor), 3), np.nan)
        points[two_view.reference_keypoint] = two_view.p_w
        poses, share = poses_of_witnesses(self.views[:-1], points, self.tracker.camera)
        if share < WITNESS_SHARE:
            return replace(two_view, ok=False, reason="the frames between disagree with two views")
        joint = consensus(self.reference, two_view, view, self.views[:-1], poses, self.tracker.camera)
        if self.reference.depth is not None:
            joint = self._likelier(joint, self._from_guess(view, two_view))
        logger.debug("initialisation: %s", joint)
        if joint.agreeing < AGREEING_SHARE or len(joint.two_view.p_w) < MIN_POINTS:
            return replace(two_view, ok=False, reason="the frames together disagree with two views")
        alone = self.reference.depth is None
        most = MAX_DIRECTION_SIGMA_ALONE if alone else self.config.max_direction_sigma
        if joint.direction_sigma > most:
            return replace(two_view, ok=False, reason="rotation and translation are not yet distinguishable")
        return joint.two_view

    def _from_guess(self, view: View, two_view: TwoView) -> Consensus:
        """The same matches refined from the poses and points of tracking against the network's depth."""
        reference, keypoint = self.reference, two_view.reference_keypoint
        p_r = self.tracker.camera.back_project(reference.features.uv[keypoint], self.guess_depth[keypoint])
        start = replace(two_view, T_c_w=self.views[-1].T_c_w, p_w=se3.transform(reference.T_w_c, p_r))
        tracked = [v.T_c_w for v in self.views[:-1]]
        joint = consensus(reference, start, view, self.views[:-1], tracked, self.tracker.camera)
        return replace(joint, two_view=self._at_guessed_scale(joint.two_view))

    def _likelier(self, a: Consensus, b: Consensus) -> Consensus:
        """Of two structures the one that fits the images; if both do, the one closer in shape to the network's depth.

        A small rotation and a small translation have similar image motion, so the cost has two minima: the right one,
        and a flatter scene with a larger rotation.
        """
        if max(a.cost, b.cost) > MAX_COST_RATIO * min(a.cost, b.cost):
            return a if a.cost < b.cost else b
        return a if self._unlike_network(a) <= self._unlike_network(b) else b

    def _unlike_network(self, joint: Consensus) -> float:
        """Robust spread of the log ratio of triangulated to predicted depth, independent of scale."""
        ratio = self._log_ratio(joint.two_view)
        return float(np.median(np.abs(ratio - np.median(ratio)))) if len(ratio) else np.inf

    def _log_ratio(self, two_view: TwoView) -> FloatArray:
        """Log of triangulated over predicted depth ``(P,)``."""
        z = se3.transform(self.reference.T_c_w, two_view.p_w)[:, 2]
        return np.log(np.maximum(z, 1e-9) / self.guess_depth[two_view.reference_keypoint])

    def _at_guessed_scale(self, two_view: TwoView) -> TwoView:
        """Structure and baseline scaled to the median of the predicted depths, as in `two_view_map`."""
        if len(two_view.p_w) == 0:
            return two_view
        scale = np.exp(-np.median(self._log_ratio(two_view)))
        T_c_r = two_view.T_c_w @ self.reference.T_w_c
        T_c_r[:3, 3] *= scale
        p_r = se3.transform(self.reference.T_c_w, two_view.p_w) * scale
        return replace(two_view, T_c_w=T_c_r @ self.reference.T_c_w, p_w=se3.transform(self.reference.T_w_c, p_r))

    def wait(self, frame: Frame, view: View, track: Track) -> None:
        """Store every few frames; above the limit, remove the one nearest to its neighbours.

        They become keyframes; otherwise only two nearby ones would constrain the first seconds of the map.
        """
        last = self.waiting[-1].frame if self.waiting else None
        if frame.stamp_s - (self.reference.stamp_s if last is None else last.stamp_s) < self.config.keyframe_gap_s:
            return
        mine, theirs = track.matched_keypoint, self.views[-1].reference_keypoint
        self.waiting.append(WaitingFrame(frame, view, mine, theirs, se3.inverse(track.T_c_w)[:3, 3], track.covariance))
        if len(self.waiting) > self.config.max_keyframes:
            centres = np.stack([self.reference.centre_w, *(w.centre_w for w in self.waiting)])
            self.waiting.pop(int(np.linalg.norm(centres[2:] - centres[:-2], axis=1).argmin()))

    def replace_map(self, frame: Frame, view: View, two_view: TwoView, lm: LmConfig) -> StartedMap:
        """Replace the predicted map by the two-view map and refine it over all its keyframes.

        Args:
            frame: The second view.
            view: Its features.
            two_view: The structure, confirmed.
            lm: Solver settings.
        """
        reference = self.reference
        colour = self.map.anchors.colour[reference.anchor[two_view.reference_keypoint]]
        self.map.remove_anchors(self._guessed)
        self.map.anchors.begin_pass()
        ids = self.map.anchors.add(
            two_view.p_w, reference.words[two_view.reference_keypoint], reference.id, False, colour
        )
        self.map.observe(reference, two_view.reference_keypoint, ids)
        poses = self._poses_between({w.frame.index for w in self.waiting})
        new = [(w.frame, self._keyframe(w, poses[w.frame.index])) for w in self.waiting if w.frame.index in poses]
        second = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, two_view.T_c_w, view.features)
        second.anchor[two_view.keypoint] = ids
        new.append((frame, second))
        for _, keyframe in new:
            self.map.add_keyframe(keyframe)
        # The essential matrix has no scale: refinement keeps the extent given by the predicted depths.
        refine(self.map, Window([k for _, k in new], [reference], ids), self.tracker.camera, lm)
        self.map.refresh_anchors(ids[self.map.anchors.alive[ids]])
        poses = self._poses_between({v.frame_index for v in self.views}) | {k.frame_index: k.T_c_w for _, k in new[:-1]}
        return StartedMap(new, {reference.frame_index: reference.T_c_w} | poses)

    def adopt(self, frame: Frame, view: View, track: Track) -> StartedMap:
        """Keep the predicted map with its depth priors; the frames so far become keyframes.

        Args:
            frame: The current frame.
            view: Its features.
            track: Its pose in the predicted map.
        """
        T_c_w = {v.frame_index: v.T_c_w for v in self.views[:-1]}
        new = []
        for waiting in self.waiting:
            keyframe = self._keyframe(waiting, T_c_w[waiting.frame.index])
            keyframe.tracked = tracked_motion(self.reference, keyframe.T_c_w, waiting.covariance)
            new.append((waiting.frame, keyframe))
        newest = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, track.T_c_w, view.features)
        newest.anchor[track.keypoint] = track.anchor
        newest.tracked = tracked_motion(self.reference, track.T_c_w, track.covariance)
        new.append((frame, newest))
        for _, keyframe in new:
            self.map.add_keyframe(keyframe)
        self.map.refresh_anchors(self._guessed)
        return StartedMap(new, {self.reference.frame_index: self.reference.T_c_w} | T_c_w)

    def _poses_between(self, frames: set[int]) -> dict[int, FloatArray]:
        """Poses of intermediate frames against the reference keyframe's anchors, by frame index."""
        observed = self.reference.keypoints_with_anchor()
        points = np.full((len(self.reference.anchor), 3), np.nan)
        points[observed] = self.map.anchors.p_w[self.reference.anchor[observed]]
        views = [v for v in self.views[:-1] if v.frame_index in frames]
        poses, _ = poses_of_witnesses(views, points, self.tracker.camera)
        return {v.frame_index: T for v, T in zip(views, poses, strict=True)}

    def _keyframe(self, waiting: WaitingFrame, T_c_w: FloatArray) -> Keyframe:
        """An intermediate frame as a keyframe that observes the anchors matched in the reference."""
        frame = waiting.frame
        keyframe = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, T_c_w, waiting.view.features)
        keyframe.anchor[waiting.keypoint] = self.reference.anchor[waiting.reference_keypoint]
        return keyframe
