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
    Structure,
    TwoView,
    at_scale_of,
    consensus,
    from_essential_matrix,
    poses_between,
    triangulated,
)
from edgeslam_torch.tracking.pose_prior import ExpectedPose
from edgeslam_torch.tracking.relative_pose import rotation_residual
from edgeslam_torch.tracking.tracker import MOTION_RADIUS_PX, Track, Tracker, View
from edgeslam_torch.types import FloatArray, Frame, IntArray

logger = logging.getLogger(__name__)

MAX_DIRECTION_SIGMA_ALONE = 0.05
"""As `InitialisationConfig.max_direction_sigma`, 2.9 degrees, without a depth network: a small rotation and a small
translation move an image in nearly the same way, and only parallax, or predicted depth, resolves the ambiguity."""
LAST_CHANCE_DEG = 0.5
"""`InitialisationConfig.min_parallax_deg` of the last frame that sees enough of the reference: 4 px at a focal length
of 500 px. Below it, motion is known to 30 degrees or less, whatever its covariance says."""

PATIENCE_S, PATIENT_DEG = 2.0, 0.3
"""`InitialisationConfig.min_parallax_deg`, 2.6 px, of a camera that has moved by as much for longer, and stays: most of
the parallax of a plane, as of a wall before a drone that climbs and sinks, is explained by a rotation."""

SAME_PICTURE_PX = 1.0
"""Median motion of the keypoints up to which a frame shows the reference's view. A static camera, or a repeated image,
matches all keypoints, which is no standard for later frames."""

AGREEING_SHARE = 0.8
"""Minimum share of inliers of all frames: 95 % if every match were correct, less a sixth of wrong matches."""


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
        self.prior = prior_of(*guess.T)
        self.max_matched = 0
        """Maximum number of inliers so far, of frames that differ from the reference."""
        self.views: list[BootstrapView] = []
        self.waiting: list[WaitingFrame] = []
        points = se3.transform(reference.T_w_c, tracker.camera.back_project(reference.features.uv, guess_depth))
        with slam_map.lock:
            slam_map.anchors.begin_pass()
            ids = slam_map.anchors.add(points, reference.words, reference.id, True, colour)
            slam_map.anchors.rest_on_prior(ids, reference.id, reference.centre_w, self.prior)
            reference.anchor[:] = ids
            slam_map.add_keyframe(reference)
            slam_map.refresh_anchors(ids)
        self._guessed = ids
        self._moved_s = np.inf
        """Stamp of the first frame with `PATIENT_DEG`."""

    def forget_guess(self) -> None:
        """Remove the predicted anchors from the map; the caller removes the reference keyframe."""
        with self.map.lock:
            self.map.remove_anchors(self._guessed)

    def track(self, view: View, T_predicted: FloatArray, expected: ExpectedPose | None = None) -> Track | None:
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

    def two_views(self, frame: Frame, view: View, track: Track, leaving: bool = False) -> TwoView:
        """Store the frame's matches and estimate the structure of all frames so far from those of corners.

        Keypoints on edges slide along them (aperture problem): hundreds on a panelled wall fit an essential matrix of a
        wrong motion, with a sharp minimum.

        Args:
            frame: The frame.
            view: Its features.
            track: Its matches.
            leaving: Whether it is the last one that sees enough of the reference.
        """
        reference, camera, keypoint = self.reference, self.tracker.camera, track.matched_keypoint
        reference_keypoint = self._reference_keypoints(track)
        uv, inv_sigma = view.features.uv[keypoint], view.inv_sigma[keypoint]
        self.views.append(BootstrapView(frame.index, uv, inv_sigma, reference_keypoint, track.T_c_w))
        if len(self.views) == 1 and not leaving:  # matches of repetitive texture fit many motions of two views
            return TwoView("two views need a third")
        both = reference.features.on_corners(reference_keypoint) & view.features.on_corners(keypoint)
        reference_keypoint, keypoint = reference_keypoint[both], keypoint[both]
        if len(keypoint) < MIN_POINTS:
            return TwoView(f"only {len(keypoint)} corners matched")
        least = np.deg2rad(self.config.min_parallax_deg)
        awaited = min(least, np.deg2rad(LAST_CHANCE_DEG)) if leaving else least
        angle = self._rotation_residual(view, reference_keypoint, keypoint)
        if angle >= np.deg2rad(PATIENT_DEG):
            self._moved_s = min(self._moved_s, frame.stamp_s)
        if frame.stamp_s - self._moved_s > PATIENCE_S:
            awaited = min(least, np.deg2rad(PATIENT_DEG))
        if angle < awaited:
            return TwoView("no parallax yet", angle)
        p_r = camera.back_project(reference.features.uv[reference_keypoint], self.guess_depth[reference_keypoint])
        guess = Structure(track.T_c_w, reference_keypoint, keypoint, se3.transform(reference.T_w_c, p_r))
        best = self._most_probable(view, guess)
        structure = best.structure
        angle = self._rotation_residual(view, structure.reference_keypoint, structure.keypoint)  # without outliers
        if angle < awaited:
            return TwoView("no parallax yet", angle)
        if best.direction_sigma > (MAX_DIRECTION_SIGMA_ALONE if self._alone else self.config.max_direction_sigma):
            return TwoView("rotation and translation are not yet distinguishable", angle)
        structure = at_scale_of(reference, structure, self.guess_depth[structure.reference_keypoint])
        structure = structure.at(triangulated(structure, reference, least))
        if best.agreeing < AGREEING_SHARE:
            return TwoView("the frames disagree with one structure", angle)
        if len(structure.p_w) < MIN_POINTS:
            return TwoView(f"only {len(structure.p_w)} points triangulate", angle)
        return TwoView("", angle, structure)

    def _rotation_residual(self, view: View, reference_keypoint: IntArray, keypoint: IntArray) -> float:
        """Median angle of matches ``(M,)`` that the best rotation leaves [rad]; zero without any."""
        uv_r, uv_c = self.reference.features.uv[reference_keypoint], view.features.uv[keypoint]
        return rotation_residual(uv_r, uv_c, self.tracker.camera) if len(keypoint) else 0.0

    @property
    def _alone(self) -> bool:
        """Whether there is no depth network."""
        return self.reference.depth is None

    def _most_probable(self, view: View, guess: Structure) -> Consensus:
        """The more probable of two minima under the network's depth, refined by the images alone.

        The result has the standard deviation under the prior: a flat valley of the reprojection error looks sharp where
        the images alone are at its wrong end.
        """
        reference, camera, between = self.reference, self.tracker.camera, self.views[:-1]
        prior = None if self._alone else self.prior[guess.reference_keypoint]
        minima = [consensus(reference, guess, view, between, [v.T_c_w for v in between], camera, prior)]
        moved = from_essential_matrix(reference, guess, view, camera, self.seed)
        if moved is not None:
            minima.append(consensus(reference, moved, view, between, self._poses(moved), camera, prior))
        best = min(minima, key=lambda minimum: minimum.cost)
        logger.debug("initialisation: %s", minima)
        if prior is None or len(best.structure.p_w) == 0:
            return best
        free = consensus(reference, best.structure, view, between, self._poses(best.structure), camera)
        return replace(free, direction_sigma=best.direction_sigma)

    def _poses(self, structure: Structure) -> list[FloatArray]:
        """Poses of the frames between against a structure."""
        points = np.full((len(self.reference.anchor), 3), np.nan)
        points[structure.reference_keypoint] = structure.p_w
        return poses_between(self.views[:-1], points, self.tracker.camera)

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

    def replace_map(self, frame: Frame, view: View, structure: Structure, lm: LmConfig) -> StartedMap:
        """Replace the predicted map by the triangulated one and refine it over all its keyframes.

        Args:
            frame: The second view.
            view: Its features.
            structure: From `two_views`.
            lm: Solver settings.
        """
        reference = self.reference
        colour = self.map.anchors.colour[reference.anchor[structure.reference_keypoint]]
        self.map.remove_anchors(self._guessed)
        self.map.anchors.begin_pass()
        ids = self.map.anchors.add(
            structure.p_w, reference.words[structure.reference_keypoint], reference.id, False, colour
        )
        self.map.observe(reference, structure.reference_keypoint, ids)
        poses = self._poses_between({w.frame.index for w in self.waiting})
        new = [(w.frame, self._keyframe(w, poses[w.frame.index])) for w in self.waiting if w.frame.index in poses]
        second = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, structure.T_c_w, view.features)
        second.anchor[structure.keypoint] = ids
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
        poses = poses_between(views, points, self.tracker.camera)
        return {v.frame_index: T for v, T in zip(views, poses, strict=True)}

    def _keyframe(self, waiting: WaitingFrame, T_c_w: FloatArray) -> Keyframe:
        """An intermediate frame as a keyframe that observes the anchors matched in the reference."""
        frame = waiting.frame
        keyframe = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, T_c_w, waiting.view.features)
        keyframe.anchor[waiting.keypoint] = self.reference.anchor[waiting.reference_keypoint]
        return keyframe
