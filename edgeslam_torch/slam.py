"""EdgeSlam: one camera and a drone's telemetry in, a metric pose for every frame and an edge map out.

Read `types.py` first. `EdgeSlam.step` is the whole system in order: features, pose, and for a keyframe depth, mapping,
refinement and edges.
"""

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import SourceError
from edgeslam_torch.frontend.depth_check import CheckedDepth, DepthFunction
from edgeslam_torch.frontend.image import as_grey, colours_at
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.frontend.repeats import REPEATED, RepeatedImages
from edgeslam_torch.fusion.motion import MotionFusion
from edgeslam_torch.fusion.published import Published, first_pose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.map.depth_prior import fit_to_anchors, sample
from edgeslam_torch.map.keyframe import Keyframe, make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edge_map import EdgeMap
from edgeslam_torch.mapping.last_refinement import last_refinement, lm_config
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.mapping.prior_anchors import depth_slack_px
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.tracking.bootstrap import Bootstrap, StartedMap
from edgeslam_torch.tracking.edge_tracker import MIN_EDGES, EdgeTracker, PointsInFrame
from edgeslam_torch.tracking.flow import FlowTracker, Followed, Template, join, template_of_keyframe, template_of_track
from edgeslam_torch.tracking.initialiser import TwoView
from edgeslam_torch.tracking.keyframe_choice import few_matches, is_due, lost_most, lost_sight
from edgeslam_torch.tracking.lazy_view import LazyView
from edgeslam_torch.tracking.relocaliser import relocalise
from edgeslam_torch.tracking.self_calibration import calibration_warning
from edgeslam_torch.tracking.tracker import Track, Tracker, View, make_view, median_parallax
from edgeslam_torch.types import (
    FloatArray,
    Frame,
    FrameStatus,
    IntArray,
    Piece,
    PointCloud,
    ScaleEstimate,
    SlamOutput,
    Support,
    TelemetrySample,
)

MIN_KEYPOINTS = 100
"""Fewer keypoints than this cannot start a map."""

ADOPT_SHARE = 0.6
"""When fewer of the first keyframe's points agree than this share of the most so far, the view has changed: the map
that the depth network made is taken as it is, since parallax may never come (a turn, a climb, a hover). At 0.4 two
views come first on redkitchen and its map is better (median 3.7 against 4.2 cm); on bare boards they come first in
some seeds, and are wrong (ATE .011 to .030 m; .0105 in all five seeds at 0.6)."""

ACCELERATION_M_S2 = 3.0
ANGULAR_ACCELERATION_RAD_S2 = 20.0
"""Standard deviations of what a hand or a small drone does: a lean of 17 degrees; half a turn a second in 0.15 s."""

DEPTH_MAP = "map from the depth network, no parallax yet"

HANDOVER_INLIERS = 50
"""When fewer of the first keyframe's points are left before initialisation, the next attempt starts from here."""

MOST_WAITING_IN_REAL_TIME = 3
"""Frames between the first two views that become keyframes in real time; while they are mapped, no other can be."""

FIRST_FRAME = "first frame, depth guessed"
AFTER_LOSS = "new piece of map after loss: pose predicted, depth guessed"
"""How a piece of map is begun, in words."""

FEW_INLIERS = 100
"""Keypoints below which edges take part in a frame's pose: as many as start a map."""

LOST_BEFORE_RESTART_S = 0.65
"""Time without a pose after which a new piece of map is started from the predicted one."""


class EdgeSlam:
    """The SLAM system.

    Args:
        camera: Intrinsics of the raw images.
        config: Settings.
        depth: Depth function in place of the one that the settings name.
        realtime: Map keyframes on a worker thread while the next frames are tracked; a keyframe that would have to
            wait is skipped and counted. Results then depend on timing.

    Example:
        >>> slam = EdgeSlam(source.camera)                                   # doctest: +SKIP
        >>> for frame in source.frames():                                    # doctest: +SKIP
        ...     print(slam.step(frame).T_w_c[:3, 3])
        >>> slam.finish()                                                    # doctest: +SKIP
        >>> stamps, poses = slam.trajectory()                                # doctest: +SKIP
    """

    def __init__(
        self,
        camera: Camera,
        config: SlamConfig | None = None,
        depth: DepthFunction | None = None,
        realtime: bool = False,
    ) -> None:
        # One thread each: spinning pools slow each other down more than they help (docs/decisions/0025).
        cv2.setNumThreads(1)
        torch.set_num_threads(1)
        self.camera = camera
        self.config = config or SlamConfig()
        depth = depth if depth is not None else _depth_from_config(self.config)
        self.depth = None if depth is None else CheckedDepth(depth)
        self.map = SlamMap(self.config.orb.scale_factor, self.config.orb.levels)
        self.log = TrajectoryLog(self.map)
        self.events = {"lost": 0, "relocalised": 0, "restarted": 0, "initialisations_refused": 0}
        """Counts of what went wrong and was mended."""
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="mapping") if realtime else None
        self._pending: Future[_Mapped] | None = None
        self._initialisation = self.config.initialisation
        if realtime:
            self.events["keyframes_skipped"] = 0
            most = min(MOST_WAITING_IN_REAL_TIME, self._initialisation.most_keyframes)
            self._initialisation = replace(self._initialisation, most_keyframes=most)
        self._orb = OrbExtractor(self.config.orb, camera)
        self._tracker = Tracker(self.map, camera, self.config.orb, self.config.tracking)
        self._flow = FlowTracker(self.map, camera, self.config.orb, self.config.flow, self.config.tracking.min_inliers)
        self._template: Template | None = None
        """What the next frames are followed from; none before there is a map."""
        self._lm = lm_config(self.config.window)
        self._mapper = Mapper(self.map, camera, self.config, self._lm)
        self.edges = EdgeMap(self.map, camera, self.config.edges, self.config.depth.prior_sigma_log)
        self._edge_tracker = EdgeTracker(self.map, self.edges, camera)
        self._T_b_c = camera_on_body(np.deg2rad(self.config.mount.tilt_deg), self.config.mount.forward_m)
        self._fusion = MotionFusion(self.config.fusion, self._T_b_c, camera.focal_sigma)
        self._fusion.refined_poses = self.log.poses
        self._repeats = RepeatedImages()
        self._calibration_warning: str | None = None
        self._is_repeat = False
        """Whether the present image shows nothing new."""
        self._published = Published()
        self._bootstrap: Bootstrap | None = None
        self._T_c_w = se3.inverse(first_pose(np.full(3, np.nan), self._T_b_c))
        self._velocity: FloatArray = np.zeros(6)
        """Tangent of the camera's motion per second, left-applied to ``T_c_w``."""
        self._stamp_s = -np.inf
        self._has_telemetry = False
        self._has_depth = False
        """Whether the depth network has said something usable yet."""
        self._recent: IntArray = np.zeros(0, dtype=np.int64)
        self._lost_frames = 0
        self._lost_since_s = np.inf
        """Stamp of the first frame of the present loss; infinite while not lost."""
        self._keyframe_s = -np.inf
        """Stamp of the newest keyframe."""
        self._stage_ms: dict[str, float] = {}
        cv2.setRNGSeed(self.config.seed)

    # -- one frame ---------------------------------------------------------------------------------------------

    def prepare(self, frame: Frame) -> LazyView:
        """What can be done with a frame before the frames before it are through, on any one thread.

        Raises:
            SourceError: If the image is not of the camera's size.
        """
        seen = LazyView(_grey(frame, self.camera), self._extract)
        if self._template is None or not self.config.flow.enabled:  # every frame is matched
            _ = seen.view
        return seen

    def _extract(self, grey: np.ndarray) -> View:
        return make_view(self._orb(grey), self.config.orb.scale_factor)

    def step(
        self, frame: Frame, telemetry: Sequence[TelemetrySample] = (), prepared: LazyView | None = None
    ) -> SlamOutput:
        """Pose of one frame; frames must come in the order of their stamps.

        Args:
            frame: Image with the lens distortion still in it, of the camera's size.
            telemetry: State messages that arrived since the last frame.
            prepared: What `prepare` made of the frame, if it was called; it is called here otherwise.

        Raises:
            SourceError: If the image is not of the camera's size, or the stamp does not increase.
        """
        if frame.stamp_s <= self._stamp_s:
            raise SourceError(f"{_name(frame)}: stamp {frame.stamp_s} s does not follow {self._stamp_s} s")
        self._stage_ms = {}
        if self._pending is not None and self._pending.done():
            self._absorb_pending()
        with self._timed("features"):
            seen = prepared if prepared is not None else self.prepare(frame)
            self._is_repeat = self._repeats.repeats(seen.grey, frame.stamp_s)
        with self._timed("fusion"):
            self._fusion.add_telemetry(telemetry)
            self._has_telemetry = self._has_telemetry or len(telemetry) > 0
        if not self.map.keyframes:
            self._face(telemetry)
            output = self._start(frame, seen.view, FIRST_FRAME)
        elif self._bootstrap is not None:
            output = self._step_bootstrap(frame, seen, self._bootstrap)
        else:
            output = self._step_mapped(frame, seen)
        self._stamp_s = frame.stamp_s
        return output

    def _step_mapped(self, frame: Frame, seen: LazyView) -> SlamOutput:
        T_predicted = self._predict(frame.stamp_s)
        with self.map.lock:
            with self._timed("tracking"):
                followed = self._follow(seen, T_predicted, frame.stamp_s)
            located = None if followed is None else self._locate_followed(followed, frame.stamp_s)
            # While the worker is busy no keyframe can be made; matching then finds what it has mapped meanwhile.
            if located is None or located.due:
                matched = self._match(seen, T_predicted, followed, frame.stamp_s)
                if matched is None and located is not None:  # in a blurred image flow finds what matching does not
                    matched = replace(located, due=False)
                located = matched
            if located is None or located.track.inliers < FEW_INLIERS:
                with self._timed("edges"):
                    located = self._with_edges(frame, seen, T_predicted, located)
            if located is not None:
                return self._tracked(frame, seen, located)
        return self._lost(frame, seen.view, T_predicted)

    def _follow(self, seen: LazyView, T_predicted: FloatArray, stamp_s: float) -> Followed | None:
        """By optical flow from the last keyframe."""
        if self._template is None or self._lost_frames > 0 or not self.config.flow.enabled:
            return None
        return self._flow.follow(self._template, seen.grey, T_predicted, self._expectation(stamp_s, T_predicted))

    def _locate_followed(self, followed: Followed, stamp_s: float) -> "_Located":
        reference = self.map.keyframes.get(followed.keyframe_id, self.map.latest())
        parallax_rad = self._parallax(followed.track, reference)
        mapping = self.config.mapping
        due = self._is_due(stamp_s, lost_sight(followed, mapping), parallax_rad, lost_most(followed, mapping))
        inv_sigma = self.config.orb.scale_factor ** -followed.octave.astype(np.float64)
        return _Located(followed.track, reference, parallax_rad, due, followed.uv, inv_sigma)

    def _match(
        self, seen: LazyView, T_predicted: FloatArray, followed: Followed | None, stamp_s: float
    ) -> "_Located | None":
        """By the frame's own keypoints: where flow finds nothing, and what a keyframe needs."""
        with self._timed("features"):
            view = seen.view
        with self._timed("tracking"):
            track, relocalised = self._find(view, T_predicted, followed, stamp_s)
        if track is None:
            return None
        reference = self._tracker.local_keyframes(track.anchor)[0]
        parallax_rad = self._parallax(track, reference)
        few = few_matches(track, reference, self.map, self.config.mapping)
        due = followed is not None or self._is_due(stamp_s, few, parallax_rad)
        self._template = template_of_track(track, view, reference, seen.grey, self.camera)
        uv, inv_sigma = view.features.uv[track.keypoint], view.inv_sigma[track.keypoint]
        return _Located(track, reference, parallax_rad, due, uv, inv_sigma, view, relocalised)

    def _with_edges(
        self, frame: Frame, seen: LazyView, T_predicted: FloatArray, located: "_Located | None"
    ) -> "_Located | None":
        """The pose from edges beside few points, or from edges alone where no point holds it."""
        expected = self._expectation(frame.stamp_s, T_predicted)
        if located is None:
            alone = None if self._lost_frames > 0 else self._edge_tracker.refine(seen.grey, T_predicted, None, expected)
            if alone is None or not alone.is_fixed:
                return None
            none = np.zeros(0, dtype=np.int64)
            track = Track(alone.T_c_w, none, none, none, none, alone.covariance)
            return _Located(track, self.map.latest(), 0.0, False, np.zeros((0, 2)), np.zeros(0), edges=alone.edges)
        anchor = located.track.anchor
        slack = depth_slack_px(self.map.anchors, anchor, located.track.T_c_w, self.camera)
        points = PointsInFrame(
            self.map.anchors.p_w[anchor],
            located.uv.astype(np.float64),
            located.inv_sigma,
            np.zeros((len(anchor), 2)) if slack is None else slack,
        )
        both = self._edge_tracker.refine(seen.grey, located.track.T_c_w, points, expected)
        if both is None or both.edges < MIN_EDGES or both.points.mean() < 0.5:
            return located
        track = replace(located.track, T_c_w=both.T_c_w, covariance=both.covariance)
        return replace(located, track=track, edges=both.edges)

    def _parallax(self, track: Track, reference: Keyframe) -> float:
        return median_parallax(self.map.anchors.p_w[track.anchor], track.T_c_w, reference.centre_w)

    def _is_due(self, stamp_s: float, changed: bool, parallax_rad: float, at_once: bool = False) -> bool:
        return is_due(changed, parallax_rad, stamp_s - self._keyframe_s, self.config.mapping, at_once)

    def _find(
        self, view: View, T_predicted: FloatArray, followed: Followed | None, stamp_s: float
    ) -> tuple[Track | None, bool]:
        """Track where flow or the prediction says, else search the keyframes; and whether the search found it."""
        expected = self._expectation(stamp_s, T_predicted)
        if followed is not None:
            track = self._tracker.track_near(view, followed.track.T_c_w, followed.track.anchor, expected)
            return None if track is None else join(track, followed, view, self.config.orb.scale_factor), False
        if self._lost_frames == 0:
            track = self._tracker.track(view, T_predicted, self._recent, expected)
            if track is not None:
                return track, False
        tries = self.config.tracking.relocalisation_keyframes
        track = relocalise(self._tracker, view, T_predicted, tries, self._lost_frames)
        return track, track is not None

    def _predict(self, stamp_s: float) -> FloatArray:
        """``T_c_w`` expected at a stamp: constant velocity over short gaps, telemetry over long ones."""
        if self._lost_frames > 0 or not np.any(self._velocity):
            estimate = self._fusion.predict(stamp_s)
            if estimate is not None and self._has_telemetry:
                return se3.inverse(estimate.T_w_c)
        # Every product doubles a rotation's rounding error; left alone it reaches centimetres in forty frames.
        return se3.orthonormalised(se3.exp(self._velocity * (stamp_s - self._stamp_s)) @ self._T_c_w)

    def _expectation(self, stamp_s: float, T_predicted: FloatArray) -> PosePrior | None:
        """The predicted pose with what accelerations allow it to be off; None where nothing tells metres."""
        if not self._has_depth:
            return None
        dt = stamp_s - self._stamp_s
        sigma_t = 0.5 * ACCELERATION_M_S2 * dt**2 / self._published.scale
        sigma_r = 0.5 * ANGULAR_ACCELERATION_RAD_S2 * dt**2
        return PosePrior(0, T_predicted, np.diag([sigma_t**-2] * 3 + [sigma_r**-2] * 3))

    def _move(self, stamp_s: float, T_c_w: FloatArray) -> None:
        """Take a visual pose as the present one."""
        self._velocity = se3.log(T_c_w @ se3.inverse(self._T_c_w)) / max(stamp_s - self._stamp_s, 1e-6)
        self._T_c_w = T_c_w

    def _tracked(self, frame: Frame, seen: LazyView, located: "_Located") -> SlamOutput:
        track, reference = located.track, located.reference
        self._move(frame.stamp_s, track.T_c_w)
        if located.relocalised and self._lost_frames > 0:
            self.events["relocalised"] += 1
            self._velocity = np.zeros(6)
        self._lost_frames = 0
        self._recent = track.anchor if track.inliers else self._recent
        if not self._is_repeat:
            with self._timed("fusion"):
                self._see(frame.stamp_s, track)
        keyframe = self._insert_keyframe(frame, seen, located) if located.due else None
        if keyframe is not None and keyframe.id in self.map.keyframes:
            reference = keyframe
        status = FrameStatus.RELOCALISED if located.relocalised else FrameStatus.TRACKED
        reason = "found again among the keyframes" if located.relocalised else ""
        if located.edges:
            reason = f"by {located.edges} edge points" + (f" beside {track.inliers} keypoints" if track.inliers else "")
        return self._output(frame, reference, status, reason, track, located.parallax_rad, keyframe is not None)

    def _see(self, stamp_s: float, track: Track) -> None:
        """Tell the fusion what the image said."""
        variance = np.diag(track.covariance)
        sigma_t = float(np.sqrt(np.mean(variance[:3]))) if np.isfinite(variance).all() else 0.01
        sigma_r = float(np.sqrt(np.mean(variance[3:]))) if np.isfinite(variance).all() else 0.01
        self._fusion.add_visual(stamp_s, se3.inverse(track.T_c_w), sigma_t, sigma_r)
        self._publish(track.T_c_w)

    def _publish(self, T_c_w: FloatArray) -> None:
        self._published = self._published.revised(self.scale, se3.inverse(T_c_w)[:3, 3])

    def _lost(self, frame: Frame, view: View, T_predicted: FloatArray) -> SlamOutput:
        if self._lost_frames == 0:
            self.events["lost"] += 1
            self._lost_since_s = frame.stamp_s
        self._lost_frames += 1
        self._T_c_w = T_predicted
        self._velocity = 0.8 * self._velocity  # a prediction is worth less every frame
        self._fusion.add_visual(frame.stamp_s, se3.inverse(T_predicted), np.inf, np.inf, tracked=False)
        # With nothing to come back to, as after dark first images, what starts a map at first starts one now.
        enough = 2 * MIN_KEYPOINTS if len(self.map.anchors) > 0 else MIN_KEYPOINTS
        if frame.stamp_s - self._lost_since_s >= LOST_BEFORE_RESTART_S and len(view.features.uv) >= enough:
            self.events["restarted"] += 1
            self._velocity = np.zeros(6)
            return self._start(frame, view, AFTER_LOSS)
        seen = len(view.features.uv)
        reason = f"only {seen} keypoints" if seen < MIN_KEYPOINTS else "too few keypoints agree with the map"
        return self._output(frame, self.map.latest(), FrameStatus.PREDICTED, reason, None, 0.0, False)

    # -- start -------------------------------------------------------------------------------------------------

    def _face(self, telemetry: Sequence[TelemetrySample]) -> None:
        """Turn the first camera the way the drone's attitude says, so that the world's z is up."""
        if telemetry:
            self._T_c_w = se3.inverse(first_pose(telemetry[-1].rpy_rad, self._T_b_c))

    def _start(self, frame: Frame, view: View, reason: str) -> SlamOutput:
        """Begin a piece of map at the present pose with guessed depths."""
        self._wait()
        self._template = None
        if self._bootstrap is not None:
            self._bootstrap.forget_guess()
            self._bootstrap = None
        keyframe = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, self._T_c_w, view.features)
        if len(view.features.uv) < MIN_KEYPOINTS:
            if not self.map.keyframes:  # something for the poses to hang on
                self.map.begin_piece(reason)
                self.map.add_keyframe(keyframe)
            reason = f"only {len(view.features.uv)} keypoints, waiting for texture"
            self._lost_frames, self._lost_since_s = 1, -np.inf
            return self._output(frame, self.map.latest(), FrameStatus.LOST, reason, None, 0.0, False)
        with self._timed("depth"):
            self._look(frame, keyframe)
        guess = self._guess_depth(keyframe)
        self.map.begin_piece(reason)
        self._bootstrap = Bootstrap(
            self.map,
            self._tracker,
            self._initialisation,
            keyframe,
            guess,
            colours_at(keyframe.image, view.features.uv),
            self.config.seed,
        )
        self.map.remove_empty_keyframes()
        self._lost_frames = 0
        return self._output(frame, keyframe, FrameStatus.STARTING, reason, None, 0.0, True)

    def _guess_depth(self, keyframe: Keyframe) -> FloatArray:
        """Depth [map units] of every keypoint before anything is triangulated and its log sigma, ``(N, 2)``."""
        guess = np.full((len(keyframe.features.uv), 2), self.config.depth.prior_sigma_log)
        network_m, sigma_log = np.full((2, len(guess)), np.nan)
        if keyframe.depth is not None:
            network_m, sigma_log = sample(keyframe.depth, keyframe.features.uv)
        known = np.isfinite(network_m)
        if not known.any():
            guess[:, 0] = self._earlier_depth()
            return guess
        guess[:, 0] = np.where(known, network_m, np.nanmedian(network_m)) / self._published.scale
        guess[known, 1] = sigma_log[known]
        return guess

    def _earlier_depth(self) -> float:
        """Median distance of what was triangulated before from the newest keyframe [map units]; 1 where nothing was."""
        earlier = np.flatnonzero(self.map.anchors.alive & ~self.map.anchors.from_depth)
        if len(earlier) == 0:
            return 1.0
        return float(np.median(np.linalg.norm(self.map.anchors.p_w[earlier] - self.map.latest().centre_w, axis=1)))

    def _step_bootstrap(self, frame: Frame, seen: LazyView, bootstrap: Bootstrap) -> SlamOutput:
        """Track against the guessed map and try to replace it."""
        view = seen.view
        with self._timed("tracking"):
            T_predicted = self._predict(frame.stamp_s)
            track = bootstrap.track(view, T_predicted, self._expectation(frame.stamp_s, T_predicted))
            if track is None or track.inliers < self.config.tracking.min_inliers:  # a fast turn: look everywhere
                track = relocalise(self._tracker, view, T_predicted, 1, 0)
        if track is None or track.inliers < 15:
            self.events["restarted"] += 1
            self._velocity = np.zeros(6)
            return self._start(frame, view, "lost sight of the first keyframe before parallax sufficed")
        self._move(frame.stamp_s, track.T_c_w)
        with self._timed("initialisation"):
            two_view = bootstrap.two_views(frame.index, view, track)
            if two_view.ok:
                two_view = bootstrap.confirm(view, two_view)
                self.events["initialisations_refused"] += not two_view.ok
        if two_view.ok:
            keyframe = self._initialise(frame, seen, bootstrap, two_view)
            return self._output(
                frame, keyframe, FrameStatus.INITIALISED, "two views", track, two_view.parallax_rad, True
            )
        if track.inliers < ADOPT_SHARE * bootstrap.most_matched and bootstrap.reference.depth is not None:
            keyframe = self._adopt(frame, seen, bootstrap, track)
            return self._output(frame, keyframe, FrameStatus.INITIALISED, DEPTH_MAP, track, two_view.parallax_rad, True)
        bootstrap.wait(frame, view, track)
        if track.inliers < HANDOVER_INLIERS:
            return self._start(frame, view, "first keyframe out of sight before parallax sufficed")
        return self._output(
            frame,
            bootstrap.reference,
            FrameStatus.STARTING,
            f"initialising: {two_view.reason}",
            track,
            two_view.parallax_rad,
            False,
        )

    def _initialise(self, frame: Frame, seen: LazyView, bootstrap: Bootstrap, two_view: TwoView) -> Keyframe:
        with self._timed("mapping"), self.map.lock:
            started = bootstrap.replace_map(frame, seen.view, two_view, self._lm)
        return self._begin_tracking(frame, seen, bootstrap.reference, started)

    def _adopt(self, frame: Frame, seen: LazyView, bootstrap: Bootstrap, track: Track) -> Keyframe:
        """The view changed before parallax came: go on with the map that the depth network made."""
        with self._timed("mapping"), self.map.lock:
            started = bootstrap.adopt(frame, seen.view, track)
        return self._begin_tracking(frame, seen, bootstrap.reference, started)

    def _begin_tracking(self, frame: Frame, seen: LazyView, reference: Keyframe, started: StartedMap) -> Keyframe:
        """Leave initialisation with a map that stands."""
        self._bootstrap = None
        self.log.replace(started.T_c_w, [reference, *(k for _, k in started.new)])
        self._T_c_w = started.T_c_w[max(started.T_c_w)]
        keyframe = started.new[-1][1]
        self._move(frame.stamp_s, keyframe.T_c_w)
        self._recent = keyframe.anchor[keyframe.anchor >= 0]
        self._template = template_of_keyframe(keyframe, seen.grey, self.camera)
        self.edges.announce(reference)
        self._compare_depth(reference)
        self._map(started.new)
        return keyframe

    # -- keyframes ---------------------------------------------------------------------------------------------

    def _insert_keyframe(self, frame: Frame, seen: LazyView, located: "_Located") -> Keyframe | None:
        """Map a new keyframe now, or on the worker; None when the worker is still busy with the last one."""
        if self._pending is not None or located.view is None:
            self.events["keyframes_skipped"] += 1
            return None
        track, features = located.track, located.view.features
        keyframe = make_keyframe(self.map.next_keyframe_id(), frame.index, frame.stamp_s, track.T_c_w, features)
        keyframe.anchor[track.keypoint] = track.anchor
        self.map.add_keyframe(keyframe, located.reference)
        self._template = template_of_keyframe(keyframe, seen.grey, self.camera)
        self._map([(frame, keyframe)])
        return keyframe

    def _map(self, new: list[tuple[Frame, Keyframe]]) -> None:
        """Map keyframes that were put into the map, now or on the worker."""
        self._keyframe_s = new[-1][1].stamp_s
        if self._worker is not None:
            self._pending = self._worker.submit(self._map_keyframes, new)
            return
        self._absorb(self._map_keyframes(new))
        newest = new[-1][1]
        self._recent = newest.anchor[newest.anchor >= 0]

    def _map_keyframes(self, new: list[tuple[Frame, Keyframe]]) -> "_Mapped":
        """Depth, mapping, refinement and edges of keyframes; the only thing that runs on the worker."""
        stage_ms: dict[str, float] = {}
        T_tracked = new[-1][1].T_c_w
        for frame, keyframe in new:
            with _timed(stage_ms, "depth"):
                self._look(frame, keyframe)
            with _timed(stage_ms, "mapping"):
                self._mapper.insert(keyframe, colours_at(keyframe.image, keyframe.features.uv))
            with _timed(stage_ms, "edges"):
                self.edges.announce(keyframe)
                self.edges.update()
        return _Mapped([k for _, k in new], T_tracked, stage_ms)

    def _absorb(self, mapped: "_Mapped") -> None:
        """Carry the present pose along with what refinement did to the newest keyframe."""
        correction = se3.inverse(mapped.T_tracked) @ mapped.keyframes[-1].T_c_w
        self._T_c_w = se3.orthonormalised(self._T_c_w @ correction)
        self._stage_ms.update(mapped.stage_ms)
        for keyframe in mapped.keyframes:
            self._compare_depth(keyframe)

    def _absorb_pending(self) -> None:
        if self._pending is not None:
            pending, self._pending = self._pending, None
            self._absorb(pending.result())

    def _wait(self) -> None:
        """Let the worker finish; afterwards the map belongs to the caller alone."""
        self._absorb_pending()

    def _look(self, frame: Frame, keyframe: Keyframe) -> None:
        """Give a keyframe its undistorted image and depth."""
        keyframe.image = self.camera.undistort_image(frame.image)
        keyframe.grey = as_grey(keyframe.image)
        keyframe.depth = None if self.depth is None else self.depth(keyframe.image, self.camera)
        self._has_depth = self._has_depth or keyframe.depth is not None

    def _compare_depth(self, keyframe: Keyframe) -> None:
        """What the network's metres say about the map's units."""
        if keyframe.depth is None:
            return
        held = keyframe.keypoints_with_anchor()
        held = held[~self.map.anchors.from_depth[keyframe.anchor[held]]]  # their depth is the network's own word
        p_w = self.map.anchors.p_w[keyframe.anchor[held]]
        z = (p_w @ keyframe.T_c_w[:3, :3].T + keyframe.T_c_w[:3, 3])[:, 2]
        fit = fit_to_anchors(sample(keyframe.depth, keyframe.features.uv[held])[0], z)
        if fit is not None:
            self._fusion.add_depth_ratio(-fit.log_ratio, fit.sigma_log)

    # -- results -----------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """Refine the whole map, measure the last edges and fix the published scale, once no frame follows."""
        self._wait()
        last_refinement(self.map, self.camera, self.edges, self.config.window)
        self._fusion.revise(*self.log.poses())
        estimate = self.scale
        if np.isfinite(estimate.sigma):
            self._published = Published(estimate.value)
        self._calibration_warning = calibration_warning(self.camera, self.keyframes())

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and refined ``T_w_c`` ``(F, 4, 4)`` of every frame stepped so far."""
        stamps, T_w_c = self.log.poses()
        return stamps, self._published.pose(T_w_c)

    def close(self) -> None:
        """Stop the worker of a real-time run."""
        if self._worker is not None:
            self._worker.shutdown(wait=True, cancel_futures=True)

    def edge_map(self) -> PointCloud:
        """Semi-dense edge points that several keyframes agree on, of one moment."""
        return self._published.cloud(self.edges.points())

    def anchors(self) -> PointCloud:
        """Triangulated anchors, of one moment."""
        with self.map.lock:
            cloud = self.map.anchors.cloud()
        return self._published.cloud(cloud)

    def keyframes(self) -> list[Keyframe]:
        """Keyframes of the map, oldest first, in the map's own units."""
        with self.map.lock:
            return [self.map.keyframes[id] for id in sorted(self.map.keyframes)]

    @property
    def scale(self) -> ScaleEstimate:
        """Metres per map unit."""
        return self._fusion.scale()

    def support(self) -> Support:
        """What the pose of every frame stepped so far rests on by now."""
        return self.log.support()

    def pieces(self) -> list[Piece]:
        """Pieces of map that the frames belong to; where one lies relative to another is not known."""
        return self.log.pieces()

    def telemetry_statistics(self) -> dict[str, float]:
        """What the drone's telemetry told: counts, delay, tilt, each source's scale; empty without telemetry."""
        return self._fusion.statistics() if self._has_telemetry else {}

    def warnings(self) -> list[str]:
        """What limits how far the results can be believed, in sentences for the run's summary."""
        depth = None if self.depth is None else self.depth.warning()
        warnings = (depth, self._warning_of_pieces(), self._repeats.warning(), self._calibration_warning)
        telemetry = self._fusion.warnings() if self._has_telemetry else []
        return [warning for warning in warnings if warning is not None] + telemetry

    def _warning_of_pieces(self) -> str | None:
        pieces = [p for p in self.pieces() if p.supported > 0]
        if len(pieces) < 2:
            return None
        spans = ", ".join(f"{p.number} ({p.first_s:.1f} to {p.last_s:.1f} s)" for p in pieces)
        return f"the map is in {len(pieces)} pieces that were never joined, {spans}: poses across them do not relate"

    # -- helpers -----------------------------------------------------------------------------------------------

    def _output(
        self,
        frame: Frame,
        keyframe: Keyframe,
        status: FrameStatus,
        reason: str,
        track: Track | None,
        parallax_rad: float,
        is_keyframe: bool,
    ) -> SlamOutput:
        self.log.append(frame.index, frame.stamp_s, keyframe.id, self._T_c_w, status.supported)
        return SlamOutput(
            index=frame.index,
            stamp_s=frame.stamp_s,
            T_w_c=self._published.pose(se3.inverse(self._T_c_w)),
            status=status,
            reason=reason or (REPEATED if self._is_repeat else ""),
            matches=0 if track is None else track.matches,
            inliers=0 if track is None else track.inliers,
            parallax_rad=parallax_rad,
            keyframe=is_keyframe,
            piece=self.map.piece_of(keyframe.id),
            scale=self.scale,
            metric=self._is_metric(),
            revision=self._published.revision,
            stage_ms=dict(self._stage_ms),
        )

    def _is_metric(self) -> bool:
        """Whether the published units are metres to within what the estimate says."""
        estimate = self.scale
        return bool(np.isfinite(estimate.sigma)) and not self._published.contradicts(estimate)

    def _timed(self, stage: str) -> AbstractContextManager[None]:
        return _timed(self._stage_ms, stage)


@dataclass(frozen=True, slots=True)
class _Located:
    """A frame with its place in the map."""

    track: Track
    reference: Keyframe
    parallax_rad: float
    """Median ray angle to the reference."""
    due: bool
    """It should become a keyframe."""
    uv: FloatArray
    """``(M, 2)`` undistorted pixels of the track's inliers."""
    inv_sigma: FloatArray
    """``(M,)`` their inverse standard deviations [1/px]."""
    view: View | None = None
    """Its features, if it was matched; without them it cannot become one."""
    relocalised: bool = False
    edges: int = 0
    """Edge points that had a part in the pose."""


@dataclass(frozen=True, slots=True)
class _Mapped:
    """What the worker hands back."""

    keyframes: list[Keyframe]
    T_tracked: FloatArray
    """``T_c_w`` of the newest before refinement."""
    stage_ms: dict[str, float]


@contextmanager
def _timed(stage_ms: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    try:
        yield
    finally:
        stage_ms[stage] = stage_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)


def _name(frame: Frame) -> str:
    return str(frame.path or f"frame {frame.index}")


def _grey(frame: Frame, camera: Camera) -> np.ndarray:
    grey = as_grey(frame.image) if frame.grey is None else frame.grey
    height, width = grey.shape
    if (width, height) != (camera.width, camera.height):
        raise SourceError(f"{_name(frame)}: image is {width}x{height}, the calibration {camera.width}x{camera.height}")
    return grey


def _depth_from_config(config: SlamConfig) -> DepthFunction | None:
    if config.depth.weights == "none":
        return None
    from edgeslam_torch.frontend.depth_network import DepthPredictor

    weights = None if config.depth.weights == "default" else Path(config.depth.weights)
    return DepthPredictor(weights=weights, backend=config.depth.backend)
