"""Start of a submap: predicted depths at its first keyframe, until two views or a changed view establish the map.

A submap starts with the flight, and at the predicted pose after a while without one.
"""

from dataclasses import replace

import numpy as np

from edgeslam_torch.atlas.atlas import MAX_CANDIDATES, Atlas
from edgeslam_torch.atlas.place_recognition import revisit_candidates
from edgeslam_torch.frontend.image import colours_at
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.depth_prior import UNKNOWN_DEPTH_LOG, sample
from edgeslam_torch.map.keyframe import Keyframe, make_keyframe
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.states.machine import Event
from edgeslam_torch.states.retroactive_localisation import MAX_FRAMES, Frames
from edgeslam_torch.states.step import Step
from edgeslam_torch.states.system import MIN_KEYPOINTS, System
from edgeslam_torch.states.tracking import Tracking
from edgeslam_torch.tracking.bootstrap import Bootstrap, StartedMap
from edgeslam_torch.tracking.initialiser import TwoView
from edgeslam_torch.tracking.lazy_view import LazyView
from edgeslam_torch.tracking.relocaliser import Reach, candidates, match_keyframe
from edgeslam_torch.tracking.tracker import Track, View
from edgeslam_torch.types import FloatArray, Frame, FrameStatus

ADOPT_SHARE = 0.6
"""Share of the maximum number of inliers below which the view has changed, and the depth network's map is adopted,
since parallax may never come (rotation, climb, hover)."""

LOST_BEFORE_RESTART_S = 0.65
"""Time without a pose after which a new submap is started at the predicted one."""

MIN_INLIERS = 15
"""Minimum number of inliers; fewer could agree with a wrong pose."""

HANDOVER_INLIERS = 50
"""Number of inliers below which the next attempt starts at the current frame."""

MAX_WAITING_IN_REAL_TIME = 3
"""Maximum number of intermediate frames that become keyframes in real time; mapping them blocks other keyframes."""

FIRST_FRAME = "first frame, depth guessed"
AFTER_LOSS = "new piece of map after loss: pose predicted, depth guessed"
"""Origin of a submap."""

NOWHERE = Reach(np.eye(4), -np.inf, -np.inf)
"""For a camera that may be in another submap: no position is expected, so that several frames must agree."""

UNCONFIRMED = "looks like a known place, the next frames must agree"
"""Reason given for an unconfirmed relocalisation."""

DEPTH_MAP = "map from the depth network, no parallax yet"


class Starting:
    """The state before a map exists.

    Args:
        system: Shared parts.
        tracking: State that takes over once there is a map.
        atlas: Atlas of the earlier submaps.
        lm: Solver settings.
        realtime: Limits the number of waiting frames.
    """

    def __init__(self, system: System, tracking: Tracking, atlas: Atlas, lm: LmConfig, realtime: bool) -> None:
        self.system = system
        self.tracking = tracking
        self.atlas = atlas
        self.lm = lm
        self.config = system.config.initialisation
        if realtime:
            most = min(MAX_WAITING_IN_REAL_TIME, self.config.max_keyframes)
            self.config = replace(self.config, max_keyframes=most)
        self._attempt: Bootstrap | None = None
        self._seen: Frames = Frames(maxlen=MAX_FRAMES)
        """Newest frames of the attempt, localised later if an earlier submap is recognised."""

    def begin(self, frame: Frame, view: View, reason: str) -> Step:
        """Start a submap at the current pose with predicted depths.

        Args:
            frame: Present frame.
            view: Its features.
            reason: Origin of the submap.
        """
        system, slam_map = self.system, self.system.map
        system.collect(wait=True)
        system.piece_began_s = frame.stamp_s
        self.tracking.forget()
        self._give_up()
        T_c_w = system.motion.T_c_w
        keyframe = make_keyframe(slam_map.next_keyframe_id(), frame.index, frame.stamp_s, T_c_w, view.features)
        if len(view.features.uv) < MIN_KEYPOINTS:
            if not system.log.records:  # a reference for the poses
                slam_map.begin_piece(reason)
                slam_map.add_keyframe(keyframe)
            reason = f"only {len(view.features.uv)} keypoints, waiting for texture"
            return Step(Event.NO_TEXTURE, slam_map.latest(), FrameStatus.LOST, reason)
        with system.timed("depth"):
            system.mapping.look(frame, keyframe)
        guess = self._guess_depth(keyframe)
        slam_map.begin_piece(reason)
        colour = colours_at(keyframe.image, view.features.uv)
        self._seen.clear()
        self._seen.append((frame.index, view))
        self._attempt = Bootstrap(slam_map, system.tracker, self.config, keyframe, guess, colour, system.config.seed)
        system.begin_submap(keyframe)
        slam_map.remove_empty_keyframes()
        return Step(Event.BEGUN, keyframe, FrameStatus.STARTING, reason, is_keyframe=True)

    def miss(self, frame: Frame, view: View, T_predicted: FloatArray, lost_since_s: float) -> Step:
        """A frame without a pose: predict it, or start a new submap there after a longer loss."""
        system = self.system
        system.events["lost"] += lost_since_s == np.inf
        system.needs_map = system.mapping.busy
        self.tracking.lost.append((frame.index, view))
        system.motion.drift(T_predicted)
        system.fusion.add_visual(frame.stamp_s, se3.inverse(T_predicted), np.inf, np.inf, tracked=False)
        seen = len(view.features.uv)
        # Without a map to return to, as after dark first images, the conditions of a first map apply.
        enough = 2 * MIN_KEYPOINTS if len(system.map.anchors) > 0 else MIN_KEYPOINTS
        waiting = self.tracking.relocaliser.waiting > 0
        if frame.stamp_s - lost_since_s >= LOST_BEFORE_RESTART_S and seen >= enough and not waiting:
            system.events["restarted"] += 1
            system.motion.stop()
            system.level(frame.stamp_s)
            return self.begin(frame, view, AFTER_LOSS)
        reason = f"only {seen} keypoints" if seen < MIN_KEYPOINTS else "too few keypoints agree with the map"
        return Step(Event.NOTHING, system.map.latest(), FrameStatus.PREDICTED, UNCONFIRMED if waiting else reason)

    def step(self, frame: Frame, seen: LazyView) -> Step:
        """Track the predicted depths and try to replace them by a better map."""
        attempt = self._attempt
        assert attempt is not None
        view = seen.view
        with self.system.timed("tracking"):
            back = self._find_earlier_piece(attempt, frame, view)
            track = self._track(attempt, frame, view) if back is None else None
        if back is not None:
            self._give_up()
            self.tracking.lost.extend(self._seen)
            return replace(self.tracking.return_to(frame, seen, back.T_c_w, back), event=Event.RETURNED)
        self._seen.append((frame.index, view))
        if track is None or track.inliers < MIN_INLIERS:
            self.system.events["restarted"] += 1
            self.system.motion.stop()
            return self.begin(frame, view, "lost sight of the first keyframe before parallax sufficed")
        self.system.motion.move(frame.stamp_s, track.T_c_w)
        self.system.fusion.follow_start(frame.stamp_s, se3.inverse(track.T_c_w))
        leaving = track.inliers < ADOPT_SHARE * attempt.max_matched and attempt.reference.depth is not None
        with self.system.timed("initialisation"):
            two_view = attempt.two_views(frame, view, track, leaving)
        if two_view.structure is None and leaving:
            with self.system.timed("mapping"), self.system.map.lock:
                started = attempt.adopt(frame, view, track)
            return self._hand_over(frame, seen, started, DEPTH_MAP, track, two_view)
        if two_view.structure is not None:
            with self.system.timed("mapping"), self.system.map.lock:
                started = attempt.replace_map(frame, view, two_view.structure, self.lm)
            return self._hand_over(frame, seen, started, "two views", track, two_view)
        attempt.wait(frame, view, track)
        if track.inliers < HANDOVER_INLIERS:
            return self.begin(frame, view, "first keyframe out of sight before parallax sufficed")
        reason = f"initialising: {two_view.reason}"
        return Step(
            Event.WAITING, attempt.reference, FrameStatus.STARTING, reason, track, parallax_rad=two_view.parallax_rad
        )

    def _give_up(self) -> None:
        """Remove the current attempt's anchors from the map."""
        if self._attempt is not None:
            self._attempt.forget_guess()
            self._attempt = None

    def _find_earlier_piece(self, attempt: Bootstrap, frame: Frame, view: View) -> Track | None:
        """Relocalise the frame in an earlier submap, whose relative pose is unknown."""
        others = self.atlas.others(self.system.map.piece_of(attempt.reference.id))
        if not others:
            return None
        keyframes = revisit_candidates(self.system.map, view.words, others, MAX_CANDIDATES)
        return self.tracking.find(frame, view, keyframes, NOWHERE)

    def _track(self, attempt: Bootstrap, frame: Frame, view: View) -> Track | None:
        system = self.system
        expected = system.expected_pose(frame.stamp_s, system.predict(frame.stamp_s, lost=False))
        track = attempt.track(view, expected.T_c_w, expected)
        if track is None or track.inliers < system.config.tracking.min_inliers:  # a fast rotation: search everywhere
            newest = candidates(system.tracker, expected.T_c_w, 1, 0)
            track = next(filter(None, (match_keyframe(system.tracker, view, k) for k in newest)), None)
            if track is not None and track.inliers < 2 * system.config.tracking.min_inliers:
                return None
        return track

    def _hand_over(
        self, frame: Frame, seen: LazyView, started: StartedMap, reason: str, track: Track, two_view: TwoView
    ) -> Step:
        """Hand over to tracking with the new map."""
        assert self._attempt is not None
        reference, keyframe = self._attempt.reference, started.new[-1][1]
        self._attempt = None
        system = self.system
        system.log.replace(started.T_c_w, [reference, *(k for _, k in started.new)])
        system.motion.T_c_w = started.T_c_w[max(started.T_c_w)]
        system.motion.move(frame.stamp_s, keyframe.T_c_w)
        system.add_earlier(reference.stamp_s, track)
        system.edges.announce(reference)
        system.compare_depth(reference)
        self.tracking.begin(seen, started.new)
        self.tracking.place_lost(reference, reference.T_c_w, reference.anchor[reference.anchor >= 0])
        return Step(
            Event.MAP_READY, keyframe, FrameStatus.INITIALISED, reason, track, two_view.parallax_rad, is_keyframe=True
        )

    def _guess_depth(self, keyframe: Keyframe) -> FloatArray:
        """Predicted depth [map units] of every keypoint and its log sigma, ``(N, 2)``."""
        guess = np.full((len(keyframe.features.uv), 2), UNKNOWN_DEPTH_LOG)
        network_m, sigma_log = np.full((2, len(guess)), np.nan)
        if keyframe.depth is not None:
            network_m, sigma_log = sample(keyframe.depth, keyframe.features.uv)
        known = np.isfinite(network_m)
        if not known.any():
            guess[:, 0] = self._earlier_depth()
            return guess
        if keyframe.depth is not None and keyframe.depth.is_relative:  # its shape alone
            guess[:, 0] = self._earlier_depth() * np.where(known, network_m, 1.0) / np.median(network_m[known])
            return guess
        # The network's scale error is constant in a scene: the new submap inherits the scale of the previous one.
        per_unit = self.system.fusion.metres.network_unit() or self.system.published.scale
        guess[:, 0] = np.where(known, network_m, np.nanmedian(network_m)) / per_unit
        guess[known, 1] = sigma_log[known]
        return guess

    def _earlier_depth(self) -> float:
        """Median distance of triangulated anchors from the newest keyframe [map units]; 1 without any."""
        anchors, latest = self.system.map.anchors, self.system.map.latest
        earlier = np.flatnonzero(anchors.alive & ~anchors.from_depth)
        if len(earlier) == 0:
            return 1.0
        return float(np.median(np.linalg.norm(anchors.p_w[earlier] - latest().centre_w, axis=1)))
