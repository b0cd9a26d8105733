"""Parts shared by all states: map, motion, scale, and the creation of keyframes."""

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.fusion.displacement import TelemetryModel
from edgeslam_torch.fusion.motion import MotionFusion
from edgeslam_torch.fusion.output_frame import OutputFrame
from edgeslam_torch.fusion.prediction import PoseEstimate
from edgeslam_torch.fusion.scale.depth_scale import DepthRatio, compared
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.pipeline import Mapped, MappingPipeline
from edgeslam_torch.stage_times import timed
from edgeslam_torch.states.drift import SHARE, Drift
from edgeslam_torch.states.submap_uncertainty import Apart
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.tracking.pose_prior import Attitude, Place, Told, TrackingPrior, Vertical
from edgeslam_torch.tracking.relocaliser import Reach, reach_after
from edgeslam_torch.tracking.tracker import Track, Tracker
from edgeslam_torch.types import FloatArray, Frame

MIN_KEYPOINTS = 100
"""Fewer keypoints than this cannot start a map."""

YOUNG_S = 10.0
"""Time after the beginning of a map in which the drone's roll and pitch hold its frames, if nothing has told metres: a
take-off and a look up and down take as long, and by then something has parallax."""
MIN_GAP_S = 0.15
"""Time between frames from which on the filter predicts the pose for tracking. Telemetry comes every 0.1 s in whole
degrees: over less, constant velocity predicts better, and flow that starts from a worse prediction ends worse."""

_BY_SENSORS = ("filter", "telemetry")
"""Predictions that carry a camera from one piece of map to another: constant velocity alone relates nothing."""

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
    published: OutputFrame = field(default_factory=OutputFrame)
    events: dict[str, int] = field(
        default_factory=lambda: {"lost": 0, "relocalised": 0, "restarted": 0, "initialisations_refused": 0, "denied": 0}
    )
    """Counts of losses, relocalisations, restarts, refused initialisations, and of poses that the images hold although
    the drone has not moved so."""
    has_telemetry: bool = False
    piece_began_s: float = -np.inf
    """Stamp of the frame with which the newest piece of map began."""
    apart: Apart = field(default_factory=Apart)
    apart_sigma: float = 0.0
    """As in `Health`, of the newest tracked frame."""
    drift: Drift = field(default_factory=Drift)
    drift_sigma: float = 0.0
    """As in `Health`, of the newest keyframe that has been mapped."""
    keyframe_s: float = -np.inf
    """Stamp of the newest keyframe, or of a later frame that needed not become one."""
    shows_nothing_new: bool = False
    """Whether the current image repeats the previous one."""
    _told: tuple[float, Told | None] = field(default=(-np.inf, None), init=False, repr=False)
    """What the drone's sensors tell of one frame: it is asked for several times."""
    stage_ms: dict[str, float] = field(default_factory=dict)
    """Times of the current frame."""

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Add the time spent inside to a stage of the current frame."""
        return timed(self.stage_ms, stage)

    # -- motion ------------------------------------------------------------------------------------------------

    def predict(self, stamp_s: float, lost: bool) -> FloatArray:
        """``T_c_w`` expected at a stamp: at constant velocity over short gaps, by telemetry over others.

        By the Kalman filter where it is fed; before it knows scale and delay, by telemetry alone.
        """
        gap = stamp_s - self.motion.stamp_s >= MIN_GAP_S
        if self.has_telemetry and (lost or self.motion.stands or (gap and self.fusion.filtering)):
            estimate = self.fusion.predict(stamp_s)
            if estimate is not None:
                return se3.inverse(estimate.T_w_c)
        return self.motion.predict(stamp_s)

    def expectation(self, stamp_s: float, T_predicted: FloatArray) -> TrackingPrior | None:
        """The predicted pose with the uncertainty due to accelerations; None without a scale.

        While its map is young, roll and pitch are the drone's: images then hardly tell a climb from a turn.
        """
        if not self.mapping.has_metres:
            return None
        told = self.fusion.vertical(stamp_s) if self._is_young(stamp_s) else None
        vertical = None if told is None else Vertical(*told)
        by_motion = self.motion.expectation(stamp_s, T_predicted, self.published.scale)
        moved = self.told(stamp_s)
        return TrackingPrior(by_motion, vertical, None if moved is None else moved.place)

    def told(self, stamp_s: float) -> Told | None:
        """What the drone's sensors tell of a frame's pose; None where none has proven to be of this flight."""
        if self._told[0] != stamp_s:
            self._told = stamp_s, self._ask(stamp_s) if self.has_telemetry else None
        return self._told[1]

    def _ask(self, stamp_s: float) -> Told | None:
        turned, reckoned = self.fusion.told(stamp_s)
        if turned is None and reckoned is None:
            return None
        place = None if reckoned is None else Place(reckoned.R_w_m, reckoned.centre, reckoned.doubt)
        return Told(None if turned is None else Attitude(*turned), place)

    def carried(self, stamp_s: float) -> PoseEstimate | None:
        """Where the drone's sensors say the camera is; None without them."""
        told = self.fusion.predict(stamp_s)
        return told if told is not None and told.source in _BY_SENSORS and np.isfinite(told.sigma_t) else None

    def reach(self, stamp_s: float, T_predicted: FloatArray) -> Reach:
        """Region that the camera can have reached during frames without a pose."""
        metre = 1.0 / self.published.scale if self.mapping.has_metres else None
        return reach_after(stamp_s - self.motion.seen_s, T_predicted, metre)

    def see(self, stamp_s: float, track: Track) -> None:
        """Pass the visual pose to the fusion, and publish the resulting scale."""
        if self.shows_nothing_new:
            return
        T_w_c = se3.inverse(track.T_c_w)
        with self.timed("fusion"):
            self.fusion.add_visual(stamp_s, T_w_c, *_sigmas(track))
            held = bool(self.apart.begun) and self.other_unit() is not None
            self.published = self.fusion.republished(self.published, T_w_c[:3, 3], held)
        if self.apart.begun:
            self.apart_sigma = self._apart_sigma(self._piece())

    def other_unit(self) -> tuple[float, float] | None:
        """As `Apart.other_unit`, of the camera's piece, if what is told now would revise the published unit: it is that
        piece's, which is brought to the first one's, as all that lies before it is published in that."""
        told, piece = self.fusion.scale(), self._piece()
        return self.apart.other_unit(piece, told) if self.published.is_wrong_by(told) else None

    def _piece(self) -> int:
        """Which the newest frame is tied to."""
        return self.map.piece_of(self.log.records[-1].keyframe_id)

    def see_again(self, since_s: float, track: Track) -> None:
        """Pass the logged frames since a stamp, which a map supports now, to the fusion, as sure as ``track``."""
        stamps_s, T_w_c = self.log.poses(since_s)
        with self.timed("fusion"):
            self.fusion.add_earlier(stamps_s, T_w_c, *_sigmas(track))

    def carried_to(self, piece: int, stamp_s: float) -> None:
        """A piece of map begins at the current pose, where prediction has carried the camera."""
        earlier = (self.map.piece_of(r.keyframe_id) for r in reversed(self.log.records))
        before, told = next((p for p in earlier if p != piece), None), self.carried(stamp_s)
        if before is not None:
            if before not in self.apart.begun:
                self.apart.unit = self.fusion.scale()
            sigma_t, sigma_r = (np.inf, np.inf) if told is None else (told.sigma_t, told.sigma_r_rad)
            self.apart.begin(piece, before, se3.inverse(self.motion.T_c_w)[:3, 3], sigma_t, sigma_r)
            self.apart_sigma = self._apart_sigma(piece)

    def _apart_sigma(self, piece: int) -> float:
        return self.published.scale * self.between(piece, self._first_piece())

    def between(self, piece: int, other: int) -> float:
        """Standard deviation per axis [map units] of where the camera is in one piece of map as seen from another;
        infinite where nothing relates them, as those of an earlier flight."""
        if piece == other:
            return 0.0
        scale, centre = self.fusion.scale(), se3.inverse(self.motion.T_c_w)[:3, 3]
        later = {piece, other} - {self._first_piece()}
        return math.hypot(*(self.apart.sigma(p, centre, scale.sigma / scale.value) for p in later))

    def _first_piece(self) -> int:
        return self.map.piece_of(self.log.records[0].keyframe_id)

    # -- keyframes ---------------------------------------------------------------------------------------------

    def map_keyframes(self, new: list[tuple[Frame, Keyframe]]) -> bool:
        """Map new keyframes; returns whether that is complete."""
        self.keyframe_s = new[-1][1].stamp_s
        return self.absorb(self.mapping.submit(new, self.telemetry("every")))

    def telemetry(self, *where: str) -> TelemetryModel | None:
        """Telemetry as it is now, if the settings want it in one of these refinements."""
        wanted = self.has_telemetry and self.config.window.telemetry in where
        model = self.fusion.telemetry() if wanted else None
        return None if model is None else replace(model, young=self._is_young(self.motion.stamp_s))

    def _is_young(self, stamp_s: float) -> bool:
        """Whether the map that a frame is tracked on has begun seconds ago."""
        return stamp_s - self.piece_began_s < YOUNG_S

    def collect(self, wait: bool = False) -> None:
        """Collect finished results of real-time mapping; with ``wait`` the caller owns the map afterwards."""
        self.absorb(self.mapping.collect(wait))

    def absorb(self, mapped: Mapped | None) -> bool:
        """Apply the refinement of the newest keyframe to the current pose."""
        if mapped is None:
            return False
        before = self.motion.T_c_w
        self.motion.correct(se3.inverse(mapped.T_tracked) @ mapped.keyframes[-1].T_c_w)
        self.fusion.map_moved(se3.inverse(self.motion.T_c_w) @ before)
        self.stage_ms.update(mapped.stage_ms)
        for keyframe in mapped.keyframes:
            self.drift.add(self.map, keyframe)
            self.compare_depth(keyframe)
        self.drift_sigma = SHARE * self.published.scale * self.drift.newest
        return True

    def compare_depth(self, keyframe: Keyframe) -> None:
        """Compare the network's depth with the map's units."""
        ratio = self._depth_ratio(keyframe)
        if ratio is not None:
            self.fusion.metres.add_depth_ratio(ratio)

    def compare_depths_again(self) -> None:
        """Compare every keyframe of the current piece of map again, once the piece has another unit."""
        piece = self.map.piece_of(self.map.latest().id)
        mine = [k for id, k in sorted(self.map.keyframes.items()) if self.map.piece_of(id) == piece]
        self.fusion.metres.replace_depth_ratios([r for k in mine if (r := self._depth_ratio(k)) is not None])

    def _depth_ratio(self, keyframe: Keyframe) -> DepthRatio | None:
        if keyframe.network_m is None:
            return None
        held = keyframe.keypoints_with_anchor()
        held = held[~self.map.anchors.from_depth[keyframe.anchor[held]]]  # their depth comes from the network itself
        p_w = self.map.anchors.p_w[keyframe.anchor[held]]
        z = (p_w @ keyframe.T_c_w[:3, :3].T + keyframe.T_c_w[:3, 3])[:, 2]
        return compared(keyframe.network_m[held], z)


def _sigmas(track: Track) -> tuple[float, float]:
    """Standard deviations per axis of a pose's translation [map units] and rotation [rad]."""
    variance = np.diag(track.covariance)
    if not np.isfinite(variance).all():
        return UNKNOWN_SIGMA, UNKNOWN_SIGMA
    return float(np.sqrt(np.mean(variance[:3]))), float(np.sqrt(np.mean(variance[3:])))
