"""Parts shared by all states: map, motion, scale, and the creation of keyframes."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.atlas.submap_graph import DRIFT, YOUNG_DRIFT, SubmapGraph
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.output_frame import OutputFrame, first_pose
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio, compared
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.rotations import smallest_rotation
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.motion_terms import vertical_since
from edgeslam_torch.mapping.pipeline import Mapped, MappingPipeline
from edgeslam_torch.stage_times import timed
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.tracking.pose_prior import ExpectedPose
from edgeslam_torch.tracking.relocaliser import Reach, reach_after
from edgeslam_torch.tracking.tracker import Track, Tracker
from edgeslam_torch.types import FloatArray, Frame, TelemetrySample

MIN_KEYPOINTS = 100
"""Fewer keypoints than this cannot start a map."""

NEW_MAP_S = 10.0
"""Age of a submap up to which the drone's roll and pitch constrain its frames if the metric scale is unknown; later
there is parallax."""
MIN_GAP_S = 0.15
"""Time between frames from which on the filter predicts the pose for tracking. Telemetry comes every 0.1 s in whole
degrees: over shorter gaps constant velocity from images is more accurate."""

UNKNOWN_SIGMA = 0.01
"""Standard deviation of a visual pose without a covariance [map units, rad]."""


@dataclass(slots=True)
class System:
    """Parts that outlive a state; states modify them only through their interfaces."""

    camera: Camera
    config: SlamConfig
    map: SlamMap
    log: TrajectoryLog
    tracker: Tracker
    edges: EdgeMap
    mapping: MappingPipeline
    fusion: MotionFusion
    motion: MotionModel
    graph: SubmapGraph
    published: OutputFrame = field(default_factory=OutputFrame)
    events: dict[str, int] = field(
        default_factory=lambda: {
            "lost": 0,
            "relocalised": 0,
            "restarted": 0,
            "contradicted": 0,
        }
    )
    """Counts of losses, relocalisations, restarts, refused initialisations, and of poses that images confirmed although
    the drone's sensors contradicted them."""
    has_telemetry: bool = False
    piece_began_s: float = -np.inf
    """Stamp of the frame with which the newest submap began."""
    keyframe_s: float = -np.inf
    """Stamp of the newest keyframe, or of a later frame that needed not become one."""
    needs_map: bool = False
    """Whether a keyframe was due, or the pose was not found, while real-time mapping was busy: the next frame waits for
    its result, since a view that leaves the map faster than this grows is lost."""
    shows_nothing_new: bool = False
    """Whether the current image repeats the previous one."""
    stage_ms: dict[str, float] = field(default_factory=dict)
    """Times of the current frame."""

    def begin_flight(
        self, stamp_s: float, telemetry: Sequence[TelemetrySample], T_b_c: FloatArray, keeps_axes: bool
    ) -> None:
        """The first frame: attitude turns the first camera so that the world's z is up, unless a loaded map
        ``keeps_axes``."""
        self.fusion.orientation.began_s = stamp_s
        if telemetry:
            self.motion.T_c_w = se3.inverse(first_pose(telemetry[-1].rpy_rad, T_b_c))
            upright = bool(np.isfinite(telemetry[-1].rpy_rad).all())
            self.published = replace(self.published, upright=upright)
            self.fusion.orientation.began_upright = upright and not keeps_axes

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Add the time spent inside to a stage of the current frame."""
        return timed(self.stage_ms, stage)

    # -- motion ------------------------------------------------------------------------------------------------

    def predict(self, stamp_s: float, lost: bool) -> FloatArray:
        """Predicted ``T_c_w``: by the Kalman filter over gaps and when lost, once it has scale and delay; otherwise at
        constant velocity, with the rotation by a gyroscope or by attitude if there is one: a drone that brakes pitches
        by more in a frame than a wallpaper's rows are apart."""
        gap = stamp_s - self.motion.stamp_s >= MIN_GAP_S
        if self.has_telemetry and (lost or gap or self.motion.velocity_unknown):
            estimate = self.fusion.predict(stamp_s)
            if estimate is not None:
                return se3.inverse(estimate.T_w_c)
        T_c_w, R_c_c = self.motion.predict(stamp_s), self.fusion.turned(self.motion.stamp_s, stamp_s)
        if R_c_c is not None:
            centre = -T_c_w[:3, :3].T @ T_c_w[:3, 3]
            T_c_w[:3, :3] = R_c_c @ self.motion.T_c_w[:3, :3]
            T_c_w[:3, 3] = -T_c_w[:3, :3] @ centre
        return T_c_w

    def expected_pose(self, stamp_s: float, T_predicted: FloatArray) -> ExpectedPose:
        """The predicted pose, with the vertical by the drone's attitude and the uncertainty due to accelerations."""
        metric = self.mapping.has_metres
        motion = self.motion.information(stamp_s, self.published.scale) if metric else np.zeros((6, 6))
        return ExpectedPose(T_predicted, motion, vertical_since(self.telemetry("every"), self.map.latest(), stamp_s))

    def reach(self, stamp_s: float, T_predicted: FloatArray) -> Reach:
        """Region that the camera can have reached during frames without a pose."""
        metre = 1.0 / self.published.scale if self.mapping.has_metres else None
        return reach_after(stamp_s - self.motion.seen_s, T_predicted, metre)

    def see(self, stamp_s: float, track: Track, reference: Keyframe) -> None:
        """Pass the visual pose to the fusion, and publish the resulting scale."""
        self.fusion.enter(self.map.piece_of(reference.id))
        if self.shows_nothing_new:
            return
        T_w_c = se3.inverse(track.T_c_w)
        with self.timed("fusion"):
            self.fusion.add_visual(stamp_s, T_w_c, *_sigmas(track))
            self.published = self.fusion.republished(self.published)

    def position_sigmas(self, piece: int) -> tuple[float, float]:
        """`Health.submap_sigma` and `drift_sigma` of the present pose in a submap."""
        if not self.log.records:
            return 0.0, 0.0
        sigma_t, _ = self.graph.uncertainty(piece, self.graph.first, se3.inverse(self.motion.T_c_w)[:3, 3])
        is_young = self.motion.stamp_s - self.log.records[0].stamp_s < NEW_MAP_S
        drift = (YOUNG_DRIFT if is_young else DRIFT) * self.graph.path
        return self.published.scale * sigma_t, self.published.scale * drift

    def add_earlier(self, since_s: float, track: Track) -> None:
        """Pass logged frames since a stamp to the fusion once a map supports them, and publish the resulting scale;
        covariance from ``track``."""
        stamps_s, T_w_c = self.log.poses(since_s)
        with self.timed("fusion"):
            self.fusion.add_earlier(stamps_s, T_w_c, *_sigmas(track))
            self.published = self.fusion.republished(self.published)

    def level(self, stamp_s: float) -> None:
        """Turn the present, predicted pose about its centre to where the drone's attitude has the vertical: the tilt of
        the last poses before a loss would be that of a new submap."""
        model = self.telemetry("every")
        up = None if model is None else model.up(np.array([stamp_s]))
        if up is not None and len(up.frame):
            T_c_w = self.motion.T_c_w.copy()
            T_c_w[:3] = smallest_rotation(T_c_w[:3, :3] @ up.up_m, up.up_c[0]) @ T_c_w[:3]
            self.motion.T_c_w = T_c_w

    def begin_submap(self, keyframe: Keyframe) -> None:
        """A submap begins with a keyframe at the present, predicted pose."""
        predicted = self.fusion.predict(keyframe.stamp_s)
        sigma = (np.inf, np.inf) if predicted is None else (predicted.sigma_t, predicted.sigma_r_rad)
        self.graph.begin(self.map.piece, keyframe, *sigma, one_unit=self.fusion.has_unit)
        self.fusion.begin_piece(self.map.piece, keyframe.stamp_s, keyframe.T_w_c, *sigma)

    # -- keyframes ---------------------------------------------------------------------------------------------

    def map_keyframes(self, new: list[tuple[Frame, Keyframe]]) -> bool:
        """Map new keyframes; returns whether that is complete."""
        self.keyframe_s = new[-1][1].stamp_s
        return self.absorb(self.mapping.submit(new, self.telemetry("every")))

    def telemetry(self, *where: str) -> TelemetryModel | None:
        """Current telemetry, if the settings use it in one of these refinements."""
        wanted = self.has_telemetry and self.config.window.telemetry in where
        model = self.fusion.telemetry() if wanted else None
        return None if model is None else replace(model, new_map=self._is_new(self.motion.stamp_s))

    def _is_new(self, stamp_s: float) -> bool:
        """Whether the submap of a frame began seconds ago."""
        return stamp_s - self.piece_began_s < NEW_MAP_S

    def collect(self, wait: bool = False) -> None:
        """Collect finished results of real-time mapping; with ``wait`` the caller owns the map afterwards."""
        self.absorb(self.mapping.collect(wait))
        self.needs_map = self.needs_map and self.mapping.busy

    def absorb(self, mapped: Mapped | None) -> bool:
        """Apply the refinement of the newest keyframe to the current pose."""
        if mapped is None:
            return False
        before = self.motion.T_c_w
        self.motion.correct(se3.inverse(mapped.T_tracked) @ mapped.keyframes[-1].T_c_w)
        self.fusion.map_moved(se3.inverse(self.motion.T_c_w) @ before)
        self.stage_ms.update(mapped.stage_ms)
        for keyframe in mapped.keyframes:
            self.graph.add(keyframe)
            self.compare_depth(keyframe)
        return True

    def compare_depth(self, keyframe: Keyframe) -> None:
        """Compare the network's depth with the map."""
        ratio = self._depth_ratio(keyframe)
        if ratio is not None:
            self.fusion.metres.add_depth_ratio(ratio)

    def compare_depths_again(self) -> None:
        """Compare every keyframe of the current submap again after a change of its scale."""
        piece = self.map.piece_of(self.map.latest().id)
        mine = [k for id, k in sorted(self.map.keyframes.items()) if self.map.piece_of(id) == piece]
        self.fusion.metres.replace_depth_ratios([r for k in mine if (r := self._depth_ratio(k)) is not None])

    def _depth_ratio(self, keyframe: Keyframe) -> DepthRatio | None:
        if keyframe.network_m is None:
            return None
        anchored = keyframe.keypoints_with_anchor()
        # Depths from the network itself say nothing about the map's scale.
        anchored = anchored[~self.map.anchors.from_depth[keyframe.anchor[anchored]]]
        p_w = self.map.anchors.p_w[keyframe.anchor[anchored]]
        z = (p_w @ keyframe.T_c_w[:3, :3].T + keyframe.T_c_w[:3, 3])[:, 2]
        return compared(keyframe.network_m[anchored], z)


def _sigmas(track: Track) -> tuple[float, float]:
    """Standard deviations per axis of a pose's translation [map units] and rotation [rad]."""
    variance = np.diag(track.covariance)
    if not np.isfinite(variance).all():
        return UNKNOWN_SIGMA, UNKNOWN_SIGMA
    return float(np.sqrt(np.mean(variance[:3]))), float(np.sqrt(np.mean(variance[3:])))
