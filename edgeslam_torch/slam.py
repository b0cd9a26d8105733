"""EdgeSlam: one camera, an IMU and a drone's telemetry in, a metric pose for every frame and an edge map out.

Read `types.py` first, then `states/machine.py`. `EdgeSlam` assembles the parts, passes every frame to the current
state, and returns the results.
"""

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from edgeslam_torch.atlas.atlas import Atlas, MapChange
from edgeslam_torch.atlas.prior_map import PriorMaps
from edgeslam_torch.atlas.saved import SavedAtlas, Unit, pack, unpack
from edgeslam_torch.atlas.submap_graph import SubmapGraph
from edgeslam_torch.compiled import compile_all
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import SourceError
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.output_frame import first_pose
from edgeslam_torch.estimation.snapshot import Present
from edgeslam_torch.frontend.depth_check import CheckedDepth, DepthFunction
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.frontend.image import as_grey
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.frontend.repeats import REPEATED, RepeatedImages
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.level import Up
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.imu import ImuModel, ImuReadings, Reading, check_readings, separated
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.observed import observations
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_depth import StereoView
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.edges.fresh_edges import MOST, measure_fresh_edges
from edgeslam_torch.mapping.last_refinement import last_refinement, lm_config
from edgeslam_torch.mapping.level.gravity import best_known, up_by_gravity
from edgeslam_torch.mapping.level.straight_edges import up_by_edges
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.mapping.pipeline import MappingPipeline
from edgeslam_torch.states.machine import Machine, State
from edgeslam_torch.states.map_merging import MapMerging
from edgeslam_torch.states.starting import FIRST_FRAME, Starting
from edgeslam_torch.states.step import Step
from edgeslam_torch.states.system import System
from edgeslam_torch.states.tracking import Tracking
from edgeslam_torch.tracking.lazy_view import LazyView
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.tracking.self_calibration import calibration_warning
from edgeslam_torch.tracking.tracker import Tracker, make_view
from edgeslam_torch.types import (
    FloatArray,
    Frame,
    Health,
    Observations,
    Piece,
    PointCloud,
    PoseNow,
    ScaleEstimate,
    SlamOutput,
    Support,
    check_frame,
)

_AROUND = 8
"""Number of keyframes whose anchors are the surroundings of the newest frame."""
_SEEN_AGAIN = 12
"""Maximum number of keyframes for stereo with its edges."""


class EdgeSlam:
    """The SLAM system.

    Args:
        camera: Intrinsics of the raw images.
        config: Settings.
        depth: Depth function instead of the configured one.
        realtime: Map keyframes on a worker thread while tracking continues; a keyframe that is due
            meanwhile is skipped and counted, and the next frame waits. Results then depend on timing.
        executor: Single-thread executor instead of the one that ``realtime`` creates.
        imu: Noise, mount and clock of the IMU whose readings `step` is given; those of a cheap one when None.

    Example:
        >>> slam = EdgeSlam(source.camera, imu=source.imu)                   # doctest: +SKIP
        >>> for frame, readings in source.steps():                           # doctest: +SKIP
        ...     print(slam.step(frame, readings).T_w_c[:3, 3])
        >>> slam.finish()                                                    # doctest: +SKIP
        >>> stamps, poses = slam.trajectory()                                # doctest: +SKIP
    """

    def __init__(
        self,
        camera: Camera,
        config: SlamConfig | None = None,
        depth: DepthFunction | None = None,
        realtime: bool = False,
        executor: Executor | None = None,
        imu: ImuModel | None = None,
    ) -> None:
        if not isinstance(camera, Camera):
            raise TypeError(f"a Camera is expected, got {type(camera).__name__}: source.camera, or load_camera(FILE)")
        if config is not None and not isinstance(config, SlamConfig):
            raise TypeError(f"a SlamConfig is expected, got {type(config).__name__}")
        self.imu = ImuModel() if imu is None else imu
        if not isinstance(self.imu, ImuModel):
            raise TypeError(f"an ImuModel is expected, got {type(imu).__name__}")
        # One thread each: spinning thread pools slow each other down (docs/decisions/24-threads-and-seeds.md).
        cv2.setNumThreads(1)
        self.camera = camera
        self.config = config = config or SlamConfig()
        depth = depth if depth is not None else _depth_from_config(config)
        self.depth = None if depth is None else CheckedDepth(depth)
        self.map = SlamMap(config.orb.scale_factor, config.orb.levels)
        self.log = TrajectoryLog(self.map)
        self.edges = EdgeMap(self.map, camera, config.edges)
        self._orb = OrbExtractor(config.orb, camera)
        self._repeats = RepeatedImages()
        self._calibration_warning: str | None = None
        self._losses: dict[str, float] = {}
        self.up: Up | None = None
        """Vertical in the output frame after `finish`: z, unless the axes are those of a loaded map. None if unknown; z
        is then the first camera's up axis."""
        self._T_b_c = camera_on_body(np.deg2rad(config.mount.tilt_deg), config.mount.forward_m)
        compile_all()  # before the first frame: no camera waits, and a first run's times are those of later ones
        if executor is None and realtime:
            executor = ThreadPoolExecutor(1, thread_name_prefix="mapping")
        lm = lm_config(config.window)
        mapper = Mapper(self.map, camera, config, lm, self.edges)
        fusion = MotionFusion(config.fusion, self._T_b_c, camera.focal_sigma, self.imu)
        fusion.refined_poses = self.log.poses
        graph = SubmapGraph(self.map, self.log, fusion.scale)
        self._system = System(
            camera,
            config,
            self.map,
            self.log,
            Tracker(self.map, camera, config.orb, config.tracking),
            self.edges,
            MappingPipeline(mapper, self.edges, camera, self.depth, executor),
            fusion,
            MotionModel(se3.inverse(first_pose(np.full(3, np.nan), self._T_b_c))),
            graph,
        )
        if realtime:
            self.events["keyframes_skipped"] = 0
        self._finished = False
        self._present = Present()
        """Immutable state for `pose_now` and `health`, replaced atomically."""
        self._machine = Machine()
        atlas = Atlas(self._system.tracker, self.edges, graph, lm, config.mapping.loop_closure)
        self._joining = MapMerging(self._system, atlas)
        self._earlier = PriorMaps()
        self._tracking = Tracking(self._system)
        self._starting = Starting(self._system, self._tracking, atlas, lm, realtime)
        cv2.setRNGSeed(config.seed)

    def __repr__(self) -> str:
        camera, unit = self.camera, self.scale.units
        return (
            f"EdgeSlam({camera.width}x{camera.height}, f {camera.fx:.1f} px, {self.state}: {len(self.log.records)} "
            f"frames, {len(self.map.keyframes)} keyframes, {unit})"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop background threads; results remain readable."""
        self.close()

    @property
    def state(self) -> State:
        """Current state of the system."""
        return self._machine.state

    @property
    def events(self) -> dict[str, int]:
        """Counts of tracking losses, relocalisations, restarts and rejected initialisations."""
        return self._system.events

    # -- one frame ---------------------------------------------------------------------------------------------

    def load_atlas(self, saved: SavedAtlas) -> None:
        """Load the map of earlier flights; call before the first frame.

        The flight starts its own submap until a place of the atlas is recognised.
        """
        if self.map.keyframes:
            raise ValueError("an atlas is loaded before the first frame")
        unpack(saved, self.map, self.edges, self.camera)
        self._earlier = PriorMaps(saved.flights, saved.keyframes, len(saved.scale))
        self._joining.atlas.known_scale.update(enumerate(saved.scale))

    def saved_atlas(self, flight: str) -> SavedAtlas:
        """The current map in the units of the output, for the next flight.

        Args:
            flight: Name of this flight, appended to the atlas's list.
        """
        shown, estimate, published = self.support().largest(), self.scale, self._system.published
        relative = replace(estimate, value=estimate.value / published.scale, sigma=estimate.sigma / published.scale)
        units = {piece: Unit(np.eye(4), known) for piece, known in self._joining.atlas.known_scale.items()}
        units[shown] = Unit(sim3.compose(published.scale, published.R, np.zeros(3)), relative)
        return pack(self.map, self.edges, self.camera, (*self._earlier.flights, flight), units)

    def prepare(self, frame: Frame) -> LazyView:
        """Feature extraction that does not depend on earlier frames; may run on another thread.

        Raises:
            SourceError: If the image is not of the camera's size.
            TypeError, ValueError: As `check_frame`.
        """
        check_frame(frame)
        seen = LazyView(frame, self.camera, lambda grey: make_view(self._orb(grey), self.config.orb.scale_factor))
        if self._tracking.needs_features:
            _ = seen.view
        return seen

    def step(self, frame: Frame, readings: Sequence[Reading] = (), prepared: LazyView | None = None) -> SlamOutput:
        """Pose of one frame; frames must come in the order of their stamps.

        Args:
            frame: Image with the lens distortion still in it, of the camera's size.
            readings: State messages and IMU readings since the last frame.
            prepared: Result of `prepare`, if it was called.

        Raises:
            SourceError: If the image is not of the camera's size, or the stamp does not increase.
            TypeError, ValueError: If the frame is no `Frame` of a uint8 image, or the readings are no list of
                `TelemetrySample` and `ImuReadings`; the state is unchanged.
        """
        check_frame(frame)
        check_readings(readings)
        if frame.stamp_s <= self._system.motion.stamp_s:
            raise SourceError(f"{frame.name}: stamp {frame.stamp_s} s does not follow {self._system.motion.stamp_s} s")
        system = self._system
        system.stage_ms = {}
        system.collect(wait=system.needs_map)
        with system.timed("joining"):
            joined = self._joining.update()
        with system.timed("features"):
            seen = prepared if prepared is not None else self.prepare(frame)
            system.shows_nothing_new = self._repeats.repeats(seen.grey, frame.stamp_s)
        with system.timed("fusion"):
            telemetry, imu_readings = separated(readings)
            system.fusion.add_imu(imu_readings)
            system.fusion.add_telemetry(telemetry)
            system.has_telemetry = system.has_telemetry or len(telemetry) > 0
        if not self.log.records:
            system.begin_flight(frame.stamp_s, telemetry, self._T_b_c, keeps_axes=self._earlier.pieces > 0)
        step = self._step(frame, seen)
        if self._earlier.pieces:
            self._joining.enter(self.map.piece_of(step.keyframe.id))
        self._machine.apply(step.event, frame.stamp_s)
        system.motion.stamp_s = frame.stamp_s
        sigmas = system.position_sigmas(self.map.piece_of(step.keyframe.id))
        self._present = system.fusion.present(frame.stamp_s, str(self.state), system.published, *sigmas)
        return self._output(frame, step, joined)

    def pose_now(self, stamp_s: float, readings: Sequence[Reading] = ()) -> PoseNow | None:
        """Predicted pose at a time after the newest frame; callable from any thread while frames are processed.

        With telemetry the video's delay is compensated: the frame stamped ``t`` shows the world at ``t - delay``, and
        telemetry received since propagates the pose to the present. Without telemetry it is constant velocity, with the
        rotation of an IMU's gyroscope up to ``stamp_s`` if readings reach that far.

        Args:
            stamp_s: Time [s] on the clock of frames and telemetry.
            readings: State messages and IMU readings since the last call of `step`.

        Returns:
            The pose in the world of `SlamOutput.T_w_c`; ``None`` before the first frame with a pose.
        """
        return self._present.pose_at(stamp_s, *separated(readings))

    def _step(self, frame: Frame, seen: LazyView) -> Step:
        """Process a frame in the current state."""
        if not self.log.records:
            return self._starting.begin(frame, seen.view, FIRST_FRAME)
        if self.state is State.STARTING:
            return self._starting.step(frame, seen)
        machine, lost = self._machine, self.state is State.LOST
        T_predicted = self._system.predict(frame.stamp_s, lost)
        if lost:
            step = self._tracking.search(frame, seen, T_predicted, machine.lost_frames)
        else:
            step = self._tracking.step(frame, seen, T_predicted)
        return step or self._starting.miss(frame, seen.view, T_predicted, machine.lost_since_s)

    def health(self) -> Health | None:
        """Reliability of the newest pose and its metres; ``None`` before the first frame. Callable from any thread."""
        return self._present.health

    # -- results -----------------------------------------------------------------------------------------------

    def finish(self) -> None:
        """After the last frame: refine the whole map, measure the remaining edges and finalise the scale."""
        self._system.collect(wait=True)
        self._joining.finish()
        if self._earlier.pieces:
            self._joining.enter(self.support().largest())
        self._finished = True
        result = last_refinement(
            self.map, self.camera, self.edges, self.config.window, self._system.telemetry("last", "every")
        )
        self._losses = {} if result is None else result.losses
        self._system.fusion.revise(*self.log.poses())
        estimate = self.scale
        if np.isfinite(estimate.sigma):
            before = self._system.published
            self._system.published = replace(before, scale=estimate.value)
        self._find_up()
        self._calibration_warning = calibration_warning(self.camera, self._shown_keyframes(), self.map.anchors.p_w)

    def _find_up(self) -> None:
        """Level the world by IMU or attitude, else by accelerometer and edges; a loaded map's axes stay."""
        system = self._system
        up = system.fusion.up()
        if up is None:
            by_edges = up_by_edges(self._shown_keyframes(), self.edges.hosts, self.camera)
            whole = self.support().whole()
            stamps_s, T_w_c = self.log.poses()
            forces = ImuReadings.joined(system.fusion.imu.forces)
            up = best_known(up_by_gravity(forces, self.imu, stamps_s[whole], T_w_c[whole]), by_edges)
        if up is None:
            return
        if not (self._earlier.pieces and system.published.upright):
            system.published = system.published.levelled(up.direction)
        self.up = replace(up, direction=system.published.R @ up.direction)

    def trajectory(self, count: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and refined ``T_w_c`` ``(F, 4, 4)`` of all frames so far, or of the first ``count``."""
        stamps, T_w_c = self.log.poses(count=count)
        return stamps, self._system.published.pose(T_w_c)

    def close(self) -> None:
        """Stop the worker of a real-time run."""
        self._system.mapping.close()

    def edge_map(self) -> PointCloud:
        """Semi-dense edge points confirmed by several keyframes, as a consistent snapshot."""
        return self._system.published.cloud(self.edges.points(self._shown_piece()))

    def anchors(self) -> PointCloud:
        """Anchors with the standard deviation of their depth, as a consistent snapshot."""
        with self.map.lock:
            cloud = self.map.anchors.cloud(self.map.anchors_seen_by(self._shown_keyframes()))
        return self._system.published.cloud(cloud)

    def surroundings(self) -> tuple[FloatArray, FloatArray]:
        """Triangulated anchors ``(N, 3)`` and edge points ``(M, 3)`` float64 of keyframes covisible with the newest
        frame, in the output frame.

        For obstacle detection: a consistent snapshot in a millisecond; both whole maps take thirty to fifty.
        """
        if not self.log.records:
            return np.zeros((0, 3)), np.zeros((0, 3))
        with self.map.lock:
            reference = self.map.keyframes[self.map.resolve(self.log.records[-1].keyframe_id)[0]]
            seen = self.map.anchors_seen_by([reference, *self.map.covisible(reference, _AROUND)])
            seen = seen[~self.map.anchors.from_depth[seen]]  # predicted depths do not validate another network
            p_w, edges_w = self.map.anchors.p_w[seen], self.edges.around(reference)
        return self._system.published.points(p_w), self._system.published.points(edges_w)

    def fresh_edges(self, image: np.ndarray, nearest: float, farthest: float) -> tuple[FloatArray, FloatArray]:
        """Edges of the newest frame with depths from covisible keyframes, before other frames have confirmed them.

        Available a few milliseconds after the frame; `edge_map` has them two seconds later, confirmed.

        Args:
            image: The newest frame, undistorted.
            nearest: Minimum depth in the units of the output.
            farthest: Maximum depth.

        Returns:
            Undistorted pixels ``(N, 2)`` and z-depths ``(N,)`` in the units of the output; empty before the first
            frame.
        """
        if not self.log.records:
            return np.zeros((0, 2)), np.zeros(0)
        with self.map.lock:
            newest = self.log.records[-1]
            T_c_w = newest.T_c_k @ self.map.pose_of(newest.keyframe_id)
            reference = self.map.keyframes[self.map.resolve(newest.keyframe_id)[0]]
            near = [reference, *self.map.covisible(reference, _SEEN_AGAIN)]
            around = [StereoView(k.grey, k.T_c_w) for k in near if k.grey is not None]
        edges = extract_edges(image, self.config.edges.canny_low, self.config.edges.canny_high, MOST)
        frame, unit = StereoView(as_grey(image), T_c_w), self._system.published.scale
        uv, z = measure_fresh_edges(frame, edges, around, nearest / unit, farthest / unit, self.camera)
        return uv, unit * z

    def observations(self) -> Observations:
        """Observations of the anchors of `anchors` in keyframes, as a consistent snapshot."""
        with self.map.lock:
            return observations(self._shown_keyframes(), self.map)

    def _shown_keyframes(self) -> list[Keyframe]:
        shown = self._shown_piece()
        return [k for id, k in sorted(self.map.keyframes.items()) if self.map.piece_of(id) == shown]

    def _shown_piece(self) -> int | None:
        """Number of the published submap: the camera's during the run, the largest one at the end."""
        if not self.log.records:
            return None
        return self.support().largest() if self._finished else self.map.piece_of(self.log.records[-1].keyframe_id)

    def keyframes(self) -> list[Keyframe]:
        """Keyframes of the map, oldest first, in map units."""
        with self.map.lock:
            return [self.map.keyframes[id] for id in sorted(self.map.keyframes)]

    @property
    def scale(self) -> ScaleEstimate:
        """Metres per map unit."""
        return self._system.fusion.scale()

    def support(self) -> Support:
        """Evidence for the pose of each frame so far."""
        return self.log.support()

    def pieces(self) -> list[Piece]:
        """Submaps that the frames belong to; the transforms between them are unknown."""
        return self.log.pieces()

    def joins(self) -> list[MapChange]:
        """Merged submaps with the evidence, in temporal order."""
        return [change for change in self._joining.atlas.changes if change.kind == "joined"]

    def closures(self) -> list[MapChange]:
        """Loops closed inside a submap, with their statistics, in temporal order."""
        return [change for change in self._joining.atlas.changes if change.kind == "loops_closed"]

    def earlier_flights(self) -> dict[str, Any] | None:
        """Statistics of the loaded atlas; None without one."""
        return self._earlier.summary(self.support(), self.map)

    def telemetry_statistics(self) -> dict[str, float]:
        """Telemetry's and IMU's statistics: counts, delay, tilt, scale by source; empty without either."""
        return self._system.fusion.statistics() if self._system.has_telemetry else self._system.fusion.imu.statistics()

    def losses(self) -> dict[str, float]:
        """The paper's losses of the final map by name, see `window_losses`; empty before `finish`."""
        return dict(self._losses)

    def warnings(self) -> list[str]:
        """Limitations of the results, as sentences for the run's summary."""
        depth = None if self.depth is None else self.depth.warning()
        upright = self._system.published.upright
        warnings = (
            depth,
            self.log.warning(),
            self._earlier.warning(self.support()),
            self._repeats.warning(self._system.fusion.flight.track.hovers),
            self._calibration_warning,
            None if upright or self.up is not None else self._system.fusion.orientation.leaning(),
        )
        return [warning for warning in warnings if warning is not None] + self._system.fusion.warnings()

    # -- helpers -----------------------------------------------------------------------------------------------

    def _output(self, frame: Frame, step: Step, joined: str) -> SlamOutput:
        system, track, health = self._system, step.track, self._present.health
        assert health is not None
        T_c_w = system.motion.T_c_w
        piece = self.map.piece_of(step.keyframe.id)
        found = self._earlier.see(frame.stamp_s, piece, step.status.supported)
        words = "; ".join(filter(None, (joined, found, step.reason)))
        self.log.append(frame.index, frame.stamp_s, step.keyframe.id, T_c_w, step.status.supported, step.T_c_before)
        return SlamOutput(
            index=frame.index,
            stamp_s=frame.stamp_s,
            T_w_c=system.published.pose(se3.inverse(T_c_w)),
            status=step.status,
            reason=words or (REPEATED if system.shows_nothing_new else ""),
            matches=0 if track is None else track.matches,
            inliers=0 if track is None else track.inliers,
            parallax_rad=step.parallax_rad,
            keyframe=step.is_keyframe,
            piece=piece,
            scale=health.scale,
            metric=health.metric,
            revision=system.published.revision,
            stage_ms=dict(system.stage_ms),
            health=health,
            unit=system.published.scale,
        )


def _depth_from_config(config: SlamConfig) -> DepthFunction | None:
    if config.depth.weights == "none":
        return None
    from edgeslam_torch.frontend.depth_network import open_depth, weights_path

    depth = config.depth
    return open_depth(weights_path(depth.weights), depth.backend, device=depth.device)
