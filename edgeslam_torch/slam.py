"""EdgeSlam: one camera and a drone's telemetry in, a metric pose for every frame and an edge map out.

Read `types.py` first. `EdgeSlam.step` is the whole system in order: features, pose, and for a keyframe mapping and
refinement.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import SourceError
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.mapping.depth_prior import fit_to_anchors, sample
from edgeslam_torch.mapping.edge_map import EdgeMap
from edgeslam_torch.mapping.keyframe import Keyframe, make_keyframe
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.mapping.refinement import Window, refine
from edgeslam_torch.mapping.slam_map import SlamMap
from edgeslam_torch.optim.problem import LmConfig, ScalePrior
from edgeslam_torch.tracking.initialiser import BootstrapView, TwoView, poses_of_witnesses, two_view_map
from edgeslam_torch.tracking.relocaliser import relocalise
from edgeslam_torch.tracking.tracker import Track, Tracker, View, make_view, median_parallax
from edgeslam_torch.types import (
    DepthMap,
    FloatArray,
    Frame,
    FrameStatus,
    IntArray,
    PointCloud,
    ScaleEstimate,
    SlamOutput,
    TelemetrySample,
)

logger = logging.getLogger(__name__)

DepthFunction = Callable[[np.ndarray, Camera], DepthMap]
"""Undistorted BGR image and its camera to depth."""

T_LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``T_w_c`` of a level camera that looks along world x; the first pose when nothing tells the attitude."""

WITNESS_SHARE = 0.6
"""Share of matches in the frames between that must agree with a two-view map, or it is refused."""

LOST_FRAMES_BEFORE_RESTART = 20
"""Frames without a pose after which a new piece of map is started from the predicted one."""


class Mode(StrEnum):
    """What the system is doing."""

    EMPTY = "empty"
    BOOTSTRAP = "bootstrap"
    MAPPED = "mapped"


@dataclass(slots=True)
class FrameRecord:
    """One row of the trajectory: a pose tied to a keyframe, so that it moves when the map is refined."""

    index: int
    stamp_s: float
    keyframe_id: int
    T_c_k: FloatArray
    status: FrameStatus


class EdgeSlam:
    """The SLAM system.

    Example:
        >>> slam = EdgeSlam(camera)                                          # doctest: +SKIP
        >>> for frame in open_source("flight").frames():                     # doctest: +SKIP
        ...     print(slam.step(frame).T_w_c[:3, 3])
        >>> slam.finish(); stamps, poses = slam.trajectory()                 # doctest: +SKIP
    """

    def __init__(self, camera: Camera, config: SlamConfig | None = None, depth: DepthFunction | None = None) -> None:
        cv2.setNumThreads(1)
        self.camera = camera
        self.config = config or SlamConfig()
        self.depth = depth if depth is not None else _depth_from_config(self.config)
        self.map = SlamMap(self.config.orb.scale_factor)
        self.orb = OrbExtractor(self.config.orb, camera)
        self.tracker = Tracker(self.map, camera, self.config.orb, self.config.tracking)
        self.lm = LmConfig(diagnostics=False)
        self.mapper = Mapper(
            self.map,
            camera,
            self.config.orb,
            self.config.tracking,
            self.config.mapping,
            self.config.depth,
            self.lm,
        )
        self.edges = EdgeMap(self.map, camera, self.config.edges, self.config.depth.prior_sigma_log)
        self.records: list[FrameRecord] = []
        self.events: dict[str, int] = {"lost": 0, "relocalised": 0, "restarted": 0, "initialisations_refused": 0}
        self._mode = Mode.EMPTY
        self._T_c_w = se3.inverse(T_LEVEL)
        self._velocity = np.eye(4)
        self._recent: IntArray = np.zeros(0, dtype=np.int64)
        self._lost_frames = 0
        self._frames_since_keyframe = 0
        self._reference_tracked = 0
        self._bootstrap_views: list[BootstrapView] = []
        self._guess_depth: FloatArray = np.zeros(0)
        self._start_image = np.zeros((camera.height, camera.width), dtype=np.uint8)
        self._stage_ms: dict[str, float] = {}
        cv2.setRNGSeed(self.config.seed)

    # -- one frame ---------------------------------------------------------------------------------------------

    def step(self, frame: Frame, telemetry: Sequence[TelemetrySample] = ()) -> SlamOutput:
        """Pose of one frame; frames must come in the order of their stamps.

        Args:
            frame: Image with the lens distortion still in it, of the camera's size.
            telemetry: State messages that arrived since the last frame.

        Raises:
            SourceError: If the image is not of the camera's size.
        """
        self._stage_ms = {}
        grey = _grey(frame, self.camera)
        with self._timed("features"):
            view = make_view(self.orb(grey), self.config.orb.scale_factor)
        if self._mode is Mode.EMPTY:
            return self._start(frame, view, "first frame, depth guessed")
        # Every product doubles a rotation's rounding error; left alone it reaches centimetres in forty frames.
        T_predicted = se3.orthonormalised(self._velocity @ self._T_c_w)
        if self._mode is Mode.BOOTSTRAP:
            return self._bootstrap(frame, view, T_predicted)
        with self._timed("tracking"):
            track, relocalised = self._track(view, T_predicted)
        if track is None:
            return self._lost(frame, view)
        return self._tracked(frame, view, track, relocalised)

    def _track(self, view: View, T_predicted: FloatArray) -> tuple[Track | None, bool]:
        if self._lost_frames == 0:
            track = self.tracker.track(view, T_predicted, self._recent)
            if track is not None:
                return track, False
        track = relocalise(
            self.tracker, view, T_predicted, self.config.tracking.relocalisation_keyframes, self._lost_frames
        )
        return track, track is not None

    def _tracked(self, frame: Frame, view: View, track: Track, relocalised: bool) -> SlamOutput:
        if relocalised:
            self.events["relocalised"] += 1
            self._velocity = np.eye(4)
        else:
            self._velocity = track.T_c_w @ se3.inverse(self._T_c_w)
        self._lost_frames = 0
        self._T_c_w = track.T_c_w
        self._recent = track.anchor
        reference = self.tracker.local_keyframes(track.anchor)[0]
        points = self.map.anchors.p_w[track.anchor]
        parallax_rad = median_parallax(points, track.T_c_w, reference.centre_w)
        is_keyframe = self._wants_keyframe(track, reference, parallax_rad)
        record_keyframe = reference
        if is_keyframe:
            record_keyframe = self._insert_keyframe(frame, view, track)
            self._T_c_w = record_keyframe.T_c_w
            held = record_keyframe.anchor[record_keyframe.anchor >= 0]
            self._recent = held
            self._frames_since_keyframe = 0
        else:
            self._frames_since_keyframe += 1
        return self._output(
            frame,
            record_keyframe,
            FrameStatus.RELOCALISED if relocalised else FrameStatus.TRACKED,
            "",
            track.matches,
            track.inliers,
            parallax_rad,
            is_keyframe,
        )

    def _lost(self, frame: Frame, view: View) -> SlamOutput:
        if self._lost_frames == 0:
            self.events["lost"] += 1
        self._lost_frames += 1
        self._T_c_w = se3.orthonormalised(self._velocity @ self._T_c_w)
        self._velocity = se3.exp(0.8 * se3.log(self._velocity))  # a prediction is worth less every frame
        reason = f"too few of {len(view.features.uv)} keypoints agree with the map"
        if self._lost_frames >= LOST_FRAMES_BEFORE_RESTART and len(view.features.uv) >= 200:
            self.events["restarted"] += 1
            return self._start(frame, view, "new piece of map after loss")
        return self._output(frame, self.map.latest(), FrameStatus.PREDICTED, reason, 0, 0, 0.0, False)

    # -- bootstrap ---------------------------------------------------------------------------------------------

    def _start(self, frame: Frame, view: View, reason: str) -> SlamOutput:
        """Begin a map at the current pose with guessed depths."""
        if len(view.features.uv) < 50:
            if self._mode is Mode.EMPTY:
                keyframe = make_keyframe(-1, frame.index, frame.stamp_s, self._T_c_w, view.features)
                self.map.keyframes.setdefault(-1, keyframe)
                self.map.keyframes[-1].T_c_w = self._T_c_w.copy()
            reason = f"only {len(view.features.uv)} keypoints, waiting for texture"
            return self._output(frame, self.map.latest(), FrameStatus.LOST, reason, 0, 0, 0.0, False)
        keyframe = make_keyframe(
            self.map.next_keyframe_id(), frame.index, frame.stamp_s, self._T_c_w, view.features
        )
        undistorted = self.camera.undistort_image(frame.image)
        with self._timed("depth"):
            keyframe.depth = None if self.depth is None else self.depth(undistorted, self.camera)
        guess = np.ones(len(view.features.uv))
        if keyframe.depth is not None:
            network, _ = sample(keyframe.depth, view.features.uv)
            guess = np.where(np.isfinite(network), network, np.nanmedian(network))
        self._guess_depth = guess
        self._start_image = undistorted
        p_c = self.camera.back_project(view.features.uv, guess)
        self.map.anchors.begin_pass()
        ids = self.map.anchors.add(
            se3.transform(keyframe.T_w_c, p_c),
            keyframe.words,
            keyframe.id,
            True,
            _colours(undistorted, view.features.uv),
        )
        keyframe.anchor[:] = ids
        self.map.add_keyframe(keyframe)
        self.map.keyframes.pop(-1, None)
        for record in self.records:
            if record.keyframe_id == -1:
                record.keyframe_id = keyframe.id
        self.map.refresh_anchors(ids)
        self._recent = ids
        self._mode = Mode.BOOTSTRAP
        self._bootstrap_views = []
        self._lost_frames = 0
        self._velocity = np.eye(4)
        return self._output(frame, keyframe, FrameStatus.INITIALISED, reason, len(ids), len(ids), 0.0, True)

    def _bootstrap(self, frame: Frame, view: View, T_predicted: FloatArray) -> SlamOutput:
        """Track against the guessed map and try to replace it."""
        reference = self.map.latest()
        ids = reference.anchor[reference.anchor >= 0]
        with self._timed("tracking"):
            track = self.tracker.refine(view, T_predicted, ids, 2.0 * self.config.tracking.motion_radius_px)
        if track is None or track.inliers < 15:
            self.events["restarted"] += 1
            return self._start(frame, view, "lost sight of the first keyframe before parallax sufficed")
        self._velocity = track.T_c_w @ se3.inverse(self._T_c_w)
        self._T_c_w = track.T_c_w
        keypoint_of_anchor = np.full(len(self.map.anchors.alive), -1, dtype=np.int64)
        keypoint_of_anchor[reference.anchor] = np.arange(len(reference.anchor))
        reference_keypoint = keypoint_of_anchor[track.matched_anchor]
        self._bootstrap_views.append(
            BootstrapView(
                frame.index,
                view.features.uv[track.matched_keypoint],
                view.inv_sigma[track.matched_keypoint],
                reference_keypoint,
                track.T_c_w,
            )
        )
        with self._timed("initialisation"):
            two_view = two_view_map(
                reference,
                self._guess_depth,
                view,
                reference_keypoint,
                track.matched_keypoint,
                self.camera,
                self.config.initialisation,
            )
            accepted = two_view.ok and self._accept(frame, view, reference, two_view)
        reason = "" if accepted else f"initialising: {two_view.reason}"
        return self._output(
            frame,
            self.map.latest() if accepted else reference,
            FrameStatus.INITIALISED,
            reason,
            track.matches,
            track.inliers,
            two_view.parallax_rad,
            accepted,
        )

    def _accept(self, frame: Frame, view: View, reference: Keyframe, two_view: TwoView) -> bool:
        """Put the two-view map in place of the guessed one, unless the frames between disagree."""
        points = np.full((len(reference.features.uv), 3), np.nan)
        points[two_view.reference_keypoint] = two_view.p_w
        _, share = poses_of_witnesses(self._bootstrap_views[:-1], points, self.camera)
        if share < WITNESS_SHARE:
            self.events["initialisations_refused"] += 1
            return False
        undistorted = self.camera.undistort_image(frame.image)
        guessed = reference.anchor[reference.anchor >= 0]
        colour = self.map.anchors.colour[guessed]
        self.map.remove_anchors(guessed)
        self.map.anchors.begin_pass()
        ids = self.map.anchors.add(
            two_view.p_w,
            reference.words[two_view.reference_keypoint],
            reference.id,
            False,
            colour[two_view.reference_keypoint],
        )
        self.map.observe(reference, two_view.reference_keypoint, ids)
        keyframe = make_keyframe(
            self.map.next_keyframe_id(), frame.index, frame.stamp_s, two_view.T_c_w, view.features
        )
        keyframe.anchor[two_view.keypoint] = ids
        self.map.add_keyframe(keyframe)
        baseline = float(np.linalg.norm(keyframe.centre_w - reference.centre_w))
        window = Window([keyframe], [reference], ids)
        refine(self.map, window, self.camera, self.lm, ScalePrior(0, 1, baseline, 0.001))
        self.map.refresh_anchors(ids[self.map.anchors.alive[ids]])
        with self._timed("depth"):
            keyframe.depth = None if self.depth is None else self.depth(undistorted, self.camera)
        self._give_image(keyframe, undistorted)
        self._give_image(reference, self._start_image)
        self.mapper.triangulate_new(keyframe, [reference], _colours(undistorted, view.features.uv))
        points[:] = np.nan
        held = reference.keypoints_with_anchor()
        points[held] = self.map.anchors.p_w[reference.anchor[held]]
        poses, _ = poses_of_witnesses(self._bootstrap_views[:-1], points, self.camera)
        pose_of_frame = {v.frame_index: T for v, T in zip(self._bootstrap_views, poses, strict=False)}
        for record in self.records:
            if record.index in pose_of_frame:
                record.T_c_k = pose_of_frame[record.index] @ se3.inverse(reference.T_c_w)
        self._bootstrap_views = []
        previous = poses[-1] if poses else reference.T_c_w
        self._velocity = keyframe.T_c_w @ se3.inverse(previous)
        self._T_c_w = keyframe.T_c_w
        self._recent = keyframe.anchor[keyframe.anchor >= 0]
        self._mode = Mode.MAPPED
        self._frames_since_keyframe = 0
        return True

    # -- keyframes ---------------------------------------------------------------------------------------------

    def _wants_keyframe(self, track: Track, reference: Keyframe, parallax_rad: float) -> bool:
        mapping = self.config.mapping
        if self._frames_since_keyframe < mapping.keyframe_min_gap:
            return False
        # Anchors that only this young map's last keyframes know would say little about overlap.
        anchors = self.map.anchors
        held = reference.anchor[reference.anchor >= 0]
        established = int((anchors.observations[held] >= min(3, len(self.map.keyframes))).sum())
        few = track.inliers < mapping.keyframe_overlap * established
        moved = parallax_rad > np.deg2rad(mapping.keyframe_parallax_deg)
        overdue = self._frames_since_keyframe >= mapping.keyframe_max_gap and parallax_rad > np.deg2rad(
            0.25 * mapping.keyframe_parallax_deg
        )
        return few or moved or overdue

    def _insert_keyframe(self, frame: Frame, view: View, track: Track) -> Keyframe:
        keyframe = make_keyframe(
            self.map.next_keyframe_id(), frame.index, frame.stamp_s, track.T_c_w, view.features
        )
        keyframe.anchor[track.keypoint] = track.anchor
        undistorted = self.camera.undistort_image(frame.image)
        with self._timed("depth"):
            keyframe.depth = None if self.depth is None else self.depth(undistorted, self.camera)
        with self._timed("mapping"):
            self.mapper.insert(keyframe, _colours(undistorted, view.features.uv))
        with self._timed("edges"):
            self._give_image(keyframe, undistorted)
            self.edges.update()
        return keyframe

    def _give_image(self, keyframe: Keyframe, undistorted: np.ndarray) -> None:
        keyframe.image = undistorted
        keyframe.grey = undistorted if undistorted.ndim == 2 else cv2.cvtColor(undistorted, cv2.COLOR_BGR2GRAY)
        self.edges.announce(keyframe)

    # -- results -----------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """Last refinement once no frame follows."""
        self.edges.update(everything=True)

    def edge_map(self) -> PointCloud:
        """Semi-dense edge points that several keyframes agree on."""
        return self.edges.points()

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and refined ``T_w_c`` ``(F, 4, 4)`` of every frame stepped so far."""
        stamps = np.array([r.stamp_s for r in self.records])
        poses = [se3.inverse(r.T_c_k @ self.map.pose_of(r.keyframe_id)) for r in self.records]
        return stamps, np.stack(poses) if poses else np.zeros((0, 4, 4))

    def anchors(self) -> PointCloud:
        """Triangulated anchors."""
        ids = np.flatnonzero(self.map.anchors.alive & ~self.map.anchors.from_depth)
        return PointCloud(
            self.map.anchors.p_w[ids].astype(np.float32),
            self.map.anchors.colour[ids],
            self.map.anchors.sigma[ids].astype(np.float32),
            self.map.anchors.observations[ids].astype(np.int32),
        )

    @property
    def scale(self) -> ScaleEstimate:
        """Metres per map unit."""
        return ScaleEstimate()

    # -- helpers -----------------------------------------------------------------------------------------------

    def _output(
        self,
        frame: Frame,
        keyframe: Keyframe,
        status: FrameStatus,
        reason: str,
        matches: int,
        inliers: int,
        parallax_rad: float,
        is_keyframe: bool,
    ) -> SlamOutput:
        self.records.append(
            FrameRecord(
                frame.index, frame.stamp_s, keyframe.id, self._T_c_w @ se3.inverse(keyframe.T_c_w), status
            )
        )
        return SlamOutput(
            index=frame.index,
            stamp_s=frame.stamp_s,
            T_w_c=se3.inverse(self._T_c_w),
            status=status,
            reason=reason,
            matches=matches,
            inliers=inliers,
            parallax_rad=parallax_rad,
            keyframe=is_keyframe,
            scale=self.scale,
            stage_ms=dict(self._stage_ms),
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._stage_ms[stage] = self._stage_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)


def _grey(frame: Frame, camera: Camera) -> np.ndarray:
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        name = frame.path or f"frame {frame.index}"
        raise SourceError(f"{name}: image is {width}x{height}, the calibration {camera.width}x{camera.height}")
    return frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)


def _colours(image: np.ndarray, uv: FloatArray) -> np.ndarray:
    """RGB at the nearest pixels of ``(N, 2)``, shape ``(N, 3)`` uint8."""
    u = np.clip(np.rint(uv[:, 0]), 0, image.shape[1] - 1).astype(np.int64)
    v = np.clip(np.rint(uv[:, 1]), 0, image.shape[0] - 1).astype(np.int64)
    colour = image[v, u]
    return np.repeat(colour[:, None], 3, axis=1) if image.ndim == 2 else colour[:, ::-1]


def _depth_from_config(config: SlamConfig) -> DepthFunction | None:
    if config.depth.weights == "none":
        return None
    from edgeslam_torch.frontend.depth import DepthPredictor

    weights = None if config.depth.weights == "default" else config.depth.weights
    return DepthPredictor(weights=weights, backend=config.depth.backend)
