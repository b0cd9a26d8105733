"""Tracking in the map by flow, by matching, and by edges where points are few; creation of keyframes."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.place_recognition import revisit_candidates
from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.atlas.submap_graph import Belief
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import Keyframe, make_keyframe, tracked_motion
from edgeslam_torch.mapping.prior_anchors import depth_slack_px, mostly_on_priors
from edgeslam_torch.noise import TRACKED_M, TRACKED_RAD
from edgeslam_torch.states.machine import Event
from edgeslam_torch.states.retroactive_localisation import MAX_FRAMES, Frames, place_lost_frames
from edgeslam_torch.states.step import Located, Step
from edgeslam_torch.states.system import System
from edgeslam_torch.tracking.edge_tracker import MIN_EDGES, EdgeTracker, PointsInFrame
from edgeslam_torch.tracking.flow import (
    MIN_SHARE,
    FlowTracker,
    Followed,
    Template,
    join,
    template_of_keyframe,
    template_of_track,
    with_followed,
)
from edgeslam_torch.tracking.keyframe_choice import (
    KNOWN_SHARE,
    due_by_flow,
    few_matches,
    is_due,
    known_share,
    lost_most,
)
from edgeslam_torch.tracking.lazy_view import LazyView
from edgeslam_torch.tracking.pose_prior import ExpectedPose
from edgeslam_torch.tracking.relocaliser import Reach, Relocaliser, candidates
from edgeslam_torch.tracking.tracker import Track, View, make_view, parallax_to
from edgeslam_torch.types import FloatArray, Frame, FrameStatus, IntArray

TRIES = 4
"""Keyframes with which a lost frame is compared; half of them near the prediction, half by similar words."""
FEW_INLIERS = 100
"""Number of keypoints below which edges contribute to a frame's pose: as many as start a map."""


class Tracking:
    """The states in which the pose is tracked in the map, by points or by edges."""

    def __init__(self, system: System) -> None:
        self.system = system
        self._flow = FlowTracker(
            system.map, system.camera, system.config.orb, system.config.flow, system.config.tracking.min_inliers
        )
        self._edge_tracker = EdgeTracker(system.map, system.edges, system.camera, system.config.tracking.edges)
        self.relocaliser = Relocaliser(system.tracker)
        self.lost: Frames = Frames(maxlen=MAX_FRAMES)
        """Newest frames of the present loss."""
        self._template: Template | None = None
        """Template for tracking the next frames; None without a map."""
        self._recent: IntArray = np.zeros(0, dtype=np.int64)
        """Anchors of the last frame, or of the newest keyframe."""

    @property
    def needs_features(self) -> bool:
        """Whether the next frame is certainly matched by keypoints."""
        return self._template is None or not self.system.config.flow.enabled

    def begin(self, seen: LazyView, new: list[tuple[Frame, Keyframe]]) -> None:
        """Start tracking on the keyframes of a new map, the last one of the current frame."""
        newest = new[-1][1]
        self._recent = newest.anchor[newest.anchor >= 0]
        self._follow_from(newest, seen)
        self._map(new)

    def forget(self) -> None:
        """Reset template and recent anchors."""
        self._template = None
        self.relocaliser.forget()

    def step(self, frame: Frame, seen: LazyView, T_predicted: FloatArray) -> Step | None:
        """Track the frame near its prediction; None if that fails."""
        with self.system.map.lock:
            expected = self.system.expected_pose(frame.stamp_s, T_predicted)
            located = self._locate(frame, seen, expected)
            if located is not None:
                located = self._check_with_sensors(frame, seen, located)
            return None if located is None else self.arrive(frame, seen, expected, located)

    def _locate(self, frame: Frame, seen: LazyView, expected: ExpectedPose) -> Located | None:
        """The frame's pose near the expected one: by flow, by matching, by edges; None if that fails."""
        system = self.system
        with system.timed("tracking"):
            followed = self._follow(seen, expected)
        located = None
        if followed is not None and followed.trusted:
            located = self._locate_followed(followed, expected, frame.stamp_s)
        # While the worker is busy no keyframe can be created; matching then finds newly mapped anchors.
        # Points that left the view cannot be followed: match the frame's own keypoints first.
        strong = followed is not None and followed.share >= MIN_SHARE
        if located is None or located.due or not strong:
            matched = self._match(frame, seen, expected, followed, strong)
            if matched is None and located is not None and followed is not None:
                matched = self._on_flow_alone(seen, located, followed, hurry=not strong)
            located = matched
        return self._by_edges(frame, seen, expected) if located is None else located

    def _check_with_sensors(self, frame: Frame, seen: LazyView, located: Located) -> Located | None:
        """Repeat the search from the sensors' prediction if the drone's sensors contradict a pose.

        On a repetitive pattern, such as wallpaper, matching may lock on the neighbouring repetition. If the second
        search gives the same pose it is kept, since telemetry alone moves no pose; None if it is a jump that the motion
        in the images so far contradicts, too.
        """
        predicted, template = self._predicted_by_sensors(frame.stamp_s), self._template
        if predicted is None or predicted[1].allows_pose(predicted[0], located.track.T_c_w):
            return located
        again = self._locate(frame, seen, self.system.expected_pose(frame.stamp_s, predicted[0]))
        if again is None or not predicted[1].allows_pose(predicted[0], again.track.T_c_w):
            self._template = template
            self.system.events["contradicted"] += 1
            motion = self.system.motion
            if not motion.velocity_unknown and predicted[1].allows_pose(predicted[0], motion.predict(frame.stamp_s)):
                return None
            return replace(located, contradicted=True)
        return again

    def search(self, frame: Frame, seen: LazyView, T_predicted: FloatArray, lost_frames: int) -> Step | None:
        """Relocalise a frame among keyframes; None without success."""
        with self.system.map.lock:
            with self.system.timed("features"):
                view = seen.view
            with self.system.timed("tracking"):
                track = self._relocalise(frame, view, T_predicted, lost_frames)
            return None if track is None else self.return_to(frame, seen, T_predicted, track)

    def return_to(self, frame: Frame, seen: LazyView, T_predicted: FloatArray, track: Track) -> Step:
        """Continue in the map at a relocalised pose."""
        self.system.events["relocalised"] += 1
        located = self._located(track, seen.view, seen, frame.stamp_s, due=False, relocalised=True)
        step = self.arrive(frame, seen, self.system.expected_pose(frame.stamp_s, T_predicted), located)
        self.system.motion.stop()
        self.place_lost(step.keyframe, track.T_c_w, track.anchor)
        return step

    def place_lost(self, keyframe: Keyframe, T_c_w: FloatArray, anchors: IntArray) -> None:
        """Localise the frames of the present loss from the pose of the frame that followed them."""
        place_lost_frames(self.lost, self.system.tracker, self.system.log, keyframe, T_c_w, anchors)

    def arrive(self, frame: Frame, seen: LazyView, expected: ExpectedPose, located: Located) -> Step:
        """Accept the frame's pose, and insert a keyframe if one is due."""
        system = self.system
        if located.track.inliers < FEW_INLIERS and not located.edges:
            located = self._with_edges(frame, seen, expected, located)
        track, reference = located.track, located.reference
        system.motion.move(frame.stamp_s, track.T_c_w)
        self.relocaliser.forget()
        self._recent = track.anchor if track.inliers else self._recent
        system.see(frame.stamp_s, track, reference)
        before = system.log.relative_to_last(track.T_c_w)
        due = located.due and (_leans(expected, track) or not self._adds_nothing(frame.stamp_s, located))
        keyframe = self._insert_keyframe(frame, seen, located) if due else None
        if keyframe is not None and keyframe.id in system.map.keyframes:
            reference = keyframe
        return Step(
            Event.POINTS if track.inliers else Event.EDGES,
            reference,
            FrameStatus.RELOCALISED if located.relocalised else FrameStatus.TRACKED,
            _in_words(located),
            track,
            located.parallax_rad,
            keyframe is not None,
            None if keyframe is None else before,
        )

    # -- by points ---------------------------------------------------------------------------------------------

    def _follow(self, seen: LazyView, expected: ExpectedPose) -> Followed | None:
        """Optical flow from the last keyframe."""
        if self._template is None or not self.system.config.flow.enabled:
            return None
        return self._flow.follow(self._template, seen.grey, expected.T_c_w, expected)

    def _locate_followed(self, followed: Followed, expected: ExpectedPose, stamp_s: float) -> Located:
        reference = self.system.map.keyframes.get(followed.keyframe_id, self.system.map.latest())
        parallax_rad = parallax_to(reference, followed.track, self.system.map.anchors.p_w)
        since_s, leans = stamp_s - self.system.keyframe_s, _leans(expected, followed.track)
        due = due_by_flow(followed, parallax_rad, since_s, self.system.config.mapping, leans)
        inv_sigma = self.system.config.orb.scale_factor ** -followed.octave.astype(np.float64)
        return Located(followed.track, reference, parallax_rad, due, followed.uv, inv_sigma)

    def _on_flow_alone(self, seen: LazyView, located: Located, followed: Followed, hurry: bool) -> Located:
        """A frame that is due for a keyframe, but none of whose keypoints matches.

        A blurred one waits for a sharper frame, unless in a ``hurry``: most of the followed points have left the view.
        If the followed keyframe has weak corners as well, the wall lacks texture and the image is not blurred.
        """
        blurred = seen.view.features.faint and not located.reference.features.faint
        if blurred and not hurry:
            return replace(located, due=False)
        features, track = with_followed(seen.view, followed, self.system.map.anchors.words)
        view = make_view(features, self.system.config.orb.scale_factor)
        return replace(located, track=track, view=view, due=True)

    def _match(
        self, frame: Frame, seen: LazyView, expected: ExpectedPose, followed: Followed | None, strong: bool
    ) -> Located | None:
        """Match the frame's own keypoints: where flow fails, or where a ``strong`` flow called a keyframe due."""
        with self.system.timed("features"):
            view = seen.view
        with self.system.timed("tracking"):
            track, relocalised = self._find(frame, view, expected, followed, strong)
        if track is None:
            return None
        at_once = followed is not None and lost_most(followed)
        return self._located(track, view, seen, frame.stamp_s, strong, relocalised, at_once)

    def _located(
        self,
        track: Track,
        view: View,
        seen: LazyView,
        stamp_s: float,
        due: bool,
        relocalised: bool,
        at_once: bool = False,
    ) -> Located:
        """The pose of a matched frame, which becomes the template for the next ones; ``at_once`` as in `is_due`."""
        system = self.system
        reference = system.tracker.local_keyframes(track.anchor)[0]
        parallax_rad = parallax_to(reference, track, system.map.anchors.p_w)
        few = few_matches(track, reference, system.map)
        since_s = stamp_s - system.keyframe_s
        due = due or is_due(few, parallax_rad, since_s, system.config.mapping, at_once)
        self._template = template_of_track(track, view, reference, seen.grey)
        uv, inv_sigma = view.features.uv[track.keypoint], view.inv_sigma[track.keypoint]
        return Located(track, reference, parallax_rad, due, uv, inv_sigma, view, relocalised)

    def _find(
        self, frame: Frame, view: View, expected: ExpectedPose, followed: Followed | None, strong: bool
    ) -> tuple[Track | None, bool]:
        """Track near flow's result or the prediction, else relocalise; and whether it was relocalised."""
        tracker = self.system.tracker
        if followed is not None and strong:
            track = tracker.track_near(view, followed.track.T_c_w, followed.track.anchor, expected)
            return None if track is None else join(track, followed, view, self.system.config.orb.scale_factor), False
        track = tracker.track(view, expected.T_c_w, self._recent, expected)
        if track is None and followed is not None:
            # After a jerk, or in a blurred image, the result of flow is nearer than the prediction.
            track = tracker.track_near(view, followed.track.T_c_w, followed.track.anchor, expected)
        if track is not None:
            return track, False
        track = self._relocalise(frame, view, expected.T_c_w, 0)
        return track, track is not None

    def _relocalise(self, frame: Frame, view: View, T_predicted: FloatArray, lost_frames: int) -> Track | None:
        """Relocalise among keyframes near the prediction and revisit candidates."""
        system = self.system
        near = candidates(system.tracker, T_predicted, TRIES - TRIES // 2, lost_frames)
        others = [k for k in system.map.keyframes.values() if not any(k is n for n in near)]
        revisits = revisit_candidates(system.map, view.words, others, TRIES // 2)
        return self.find(frame, view, [*near, *revisits], system.reach(frame.stamp_s, T_predicted))

    def find(self, frame: Frame, view: View, keyframes: list[Keyframe], reach: Reach) -> Track | None:
        """Relocalise a frame among keyframes; earlier unconfirmed frames get their poses as well."""
        system = self.system
        found = self.relocaliser.find(frame.index, view, keyframes, reach)
        if found is None or not self._may_be_at(found.track, frame.stamp_s):
            return None
        if found.earlier:
            system.log.replace(found.earlier, system.tracker.local_keyframes(found.track.anchor)[:1])
        return found.track

    def _may_be_at(self, track: Track, stamp_s: float) -> bool:
        """Whether a relocalised pose agrees with the sensors' prediction: on repetitive walls several frames match
        metres away. Images decide alone without sensors, and where nothing relates both places."""
        system = self.system
        predicted, records = system.fusion.predict(stamp_s) or system.fusion.begun, system.log.records
        if predicted is None or not records:
            return True
        here = system.map.keyframes[system.map.resolve(records[-1].keyframe_id)[0]]
        there = system.tracker.local_keyframes(track.anchor)[0]
        depth = float(np.median(se3.transform(track.T_c_w, system.map.anchors.p_w[track.anchor])[:, 2]))
        belief = system.graph.between(here, there, depth)
        if belief is None or there.stamp_s == BEFORE_S:
            return True
        belief = belief.plus(predicted.sigma_t, predicted.sigma_r_rad)
        return belief.allows_pose(se3.inverse(predicted.T_w_c), track.T_c_w)

    # -- by edges ----------------------------------------------------------------------------------------------

    def _by_edges(self, frame: Frame, seen: LazyView, expected: ExpectedPose) -> Located | None:
        """The pose from edges alone."""
        with self.system.timed("edges"):
            alone = self._edge_tracker.refine(seen.grey, expected.T_c_w, None, expected.prior(True))
        if alone is None or not alone.is_fixed or self._contradicts_sensors(alone.T_c_w, frame.stamp_s):
            return None
        none = np.zeros(0, dtype=np.int64)
        track = Track(alone.T_c_w, none, none, none, none, alone.covariance)
        return Located(track, self.system.map.latest(), 0.0, False, np.zeros((0, 2)), np.zeros(0), edges=alone.edges)

    def _with_edges(self, frame: Frame, seen: LazyView, expected: ExpectedPose, located: Located) -> Located:
        """The pose from edges and few points."""
        system, anchor = self.system, located.track.anchor
        slack = depth_slack_px(system.map.anchors, anchor, located.track.T_c_w, system.camera)
        points = PointsInFrame(
            system.map.anchors.p_w[anchor],
            located.uv.astype(np.float64),
            located.inv_sigma,
            np.zeros((len(anchor), 2)) if slack is None else slack,
        )
        with system.timed("edges"):
            both = self._edge_tracker.refine(seen.grey, located.track.T_c_w, points, expected.prior(True))
        if both is None or both.edges < MIN_EDGES or both.points.mean() < 0.5:
            return located
        if self._contradicts_sensors(both.T_c_w, frame.stamp_s):
            return located
        track = replace(located.track, T_c_w=both.T_c_w, covariance=both.covariance)
        return replace(located, track=track, edges=both.edges)

    def _contradicts_sensors(self, T_c_w: FloatArray, stamp_s: float) -> bool:
        """Whether the sensors contradict a pose ``(4, 4)`` by edges; parallel edges constrain few directions."""
        predicted = self._predicted_by_sensors(stamp_s)
        return predicted is not None and not predicted[1].allows_pose(predicted[0], T_c_w)

    def _predicted_by_sensors(self, stamp_s: float) -> tuple[FloatArray, Belief] | None:
        """``T_c_w`` ``(4, 4)`` by the Kalman filter and how far a tracked pose may be from it; None without validated
        sensors."""
        predicted = self.system.fusion.predict(stamp_s)
        if predicted is None:
            return None
        belief = Belief(TRACKED_M / self.system.fusion.scale().value, TRACKED_RAD)
        return se3.inverse(predicted.T_w_c), belief.plus(predicted.sigma_t, predicted.sigma_r_rad)

    # -- keyframes ---------------------------------------------------------------------------------------------

    def _adds_nothing(self, stamp_s: float, located: Located) -> bool:
        """Whether earlier keyframes have already seen most of the view; the next check follows after a gap."""
        system = self.system
        if located.view is None or located.track.inliers < FEW_INLIERS:
            return False
        uv = located.view.features.uv
        share = known_share(located.track, uv, stamp_s, system.map, system.camera, system.config.mapping)
        if share < KNOWN_SHARE:
            return False
        system.keyframe_s = stamp_s
        return True

    def _insert_keyframe(self, frame: Frame, seen: LazyView, located: Located) -> Keyframe | None:
        """Map a new keyframe; None while real-time mapping is busy with the last one."""
        system = self.system
        if system.mapping.busy or located.view is None:
            system.needs_map = system.mapping.busy
            system.events["keyframes_skipped"] = system.events.get("keyframes_skipped", 0) + 1
            return None
        track, features = located.track, located.view.features
        keyframe = make_keyframe(system.map.next_keyframe_id(), frame.index, frame.stamp_s, track.T_c_w, features)
        keyframe.anchor[track.keypoint] = track.anchor
        if mostly_on_priors(system.map.anchors, track.anchor):
            keyframe.tracked = tracked_motion(located.reference, track.T_c_w, track.covariance)
        system.map.add_keyframe(keyframe, located.reference)
        self._follow_from(keyframe, seen)
        self._map([(frame, keyframe)])
        return keyframe

    def _follow_from(self, keyframe: Keyframe, seen: LazyView) -> None:
        self._template = template_of_keyframe(keyframe, seen.grey)

    def _map(self, new: list[tuple[Frame, Keyframe]]) -> None:
        if self.system.map_keyframes(new):
            newest = new[-1][1]
            self._recent = newest.anchor[newest.anchor >= 0]


def _leans(expected: ExpectedPose, track: Track) -> bool:
    """Whether the drone's attitude contradicts a tracked pose."""
    return expected.vertical is not None and expected.vertical.contradicts(track.T_c_w)


def _in_words(located: Located) -> str:
    """Reason of a pose that is not simply tracked on keypoints."""
    inliers, reasons = located.track.inliers, []
    if located.edges:
        reasons.append(f"by {located.edges} edge points" + (f" and {inliers} keypoints" if inliers else ""))
    elif located.relocalised:
        reasons.append("relocalised among the keyframes")
    if located.contradicted:
        reasons.append("contradicted by the drone's sensors")
    return "; ".join(reasons)
