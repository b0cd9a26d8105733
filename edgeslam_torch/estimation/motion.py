"""Fusion of map and telemetry: metric scale, gravity, video delay, and pose prediction without vision.

`MotionFusion` receives frames and messages and delegates to its parts: `telemetry/remembered` (messages, poses, delay,
gates), `orientation` (map and camera in the drone's world), `scale_estimator` (the scale and its sources),
`telemetry/comparison` (validation of telemetry), `telemetry_scale` and `filter_feed`. Reading a result computes
nothing: each tracked frame may trigger a fit, whose results are valid until the next.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np

from edgeslam_torch.estimation.config import INTERVAL_S, MAX_GAP_S, WINDOW_S, FusionConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.filter.filter_feed import FilterFeed, PoseEstimate
from edgeslam_torch.estimation.orientation import Orientation
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.scale.belief import disagreement, mean
from edgeslam_torch.estimation.scale.submap_scale import SubmapScale
from edgeslam_torch.estimation.scale_estimator import ScaleEstimator
from edgeslam_torch.estimation.sensors.attitude import turned
from edgeslam_torch.estimation.sensors.height import climb
from edgeslam_torch.estimation.sensors.imu import REACH_S as IMU_REACH_S
from edgeslam_torch.estimation.sensors.imu import Imu
from edgeslam_torch.estimation.snapshot import Present, Snapshot
from edgeslam_torch.estimation.telemetry.comparison import Comparison
from edgeslam_torch.estimation.telemetry.delay import DelaySearch
from edgeslam_torch.estimation.telemetry.remembered import Remembered
from edgeslam_torch.estimation.telemetry.sensor_validation import HEIGHTS, Reading, SensorGate
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import VisualMemory, VisualPose
from edgeslam_torch.estimation.telemetry_scale import TelemetryScale
from edgeslam_torch.geometry.level import Up
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.noise import MOUNT_RAD
from edgeslam_torch.types import FloatArray, Health, ScaleEstimate, TelemetrySample

_REFIT_S = 1.0
_FIRST_FIT_S = 0.5
"""Time between fits as long as telemetry has given no scale or no delay: the length of a displacement."""
_REFIT_SHARE = 0.12
"""Time between fits as a share of the duration so far: later fits cost more and change less."""


class MotionFusion:
    """Aligns the visual map with the drone's telemetry; `EdgeSlam` calls it for every frame and every packet.

    The map may be in any fixed gauge: ``T_w_c`` in arbitrary units and axes.
    A frame stamped ``t`` corresponds to telemetry at ``t - delay``.

    Args:
        config: Settings.
        T_b_c: Camera in the body frame ``(4, 4)`` [m]; for a Tello tilted down by some 12 degrees.
        focal_sigma: Relative standard deviation of the camera's focal length; a wrong one bends the map and its scale.
        imu: Noise, mount and clock of an IMU; those of a cheap one when None.
    """

    def __init__(
        self, config: FusionConfig, T_b_c: FloatArray, focal_sigma: float = 0.0, imu: ImuModel | None = None
    ) -> None:
        self.config = config
        given = np.asarray(T_b_c, dtype=np.float64)
        self.refined_poses: Callable[[float], tuple[FloatArray, FloatArray]] | None = None
        """Returns stamps and poses of the frames since a stamp, in the present map; called before each fit."""
        self.flight = Remembered(
            config,
            TelemetryTrack(config.velocity_frame, MAX_GAP_S),
            VisualMemory(INTERVAL_S, WINDOW_S, MAX_GAP_S),
            DelaySearch(config, given[:3, :3]),
            SensorGate(),
        )
        self.orientation = Orientation(self.flight, given)
        self.metres = ScaleEstimator(config, focal_sigma)
        self.imu = Imu(ImuModel() if imu is None else imu)
        self._sample: TelemetrySample | None = None
        """The newest state message."""
        self._comparison = Comparison(self.flight)
        self._filter = FilterFeed(config, given)
        self.submaps: dict[int, SubmapScale] = {}
        """Scales of submaps that began on predicted depths, by their numbers; none of one that is joined to another, or
        as well known as the map's. `MapMerging` removes those."""
        self._begun: VisualPose | None = None
        """Newest pose of the submap that began last, before its first tracked frame."""
        self._fitted_s = self._known_s = -math.inf
        """Stamps of the last fit, and of the last one that determined the scale."""
        self._counts: Counter[str] = Counter()

    # --- input ---------------------------------------------------------------------------------------------------

    def add_telemetry(self, samples: Sequence[TelemetrySample]) -> None:
        """State messages in the order of arrival."""
        for sample in self.flight.track.add(samples):
            if np.isfinite(sample.rpy_rad).all():
                self.orientation.note_attitude(sample.stamp_s)
            before, self._sample = self._sample, sample
            ranged_m_s = math.nan
            # The printed filter takes velocities as they are; those in body axes have no vertical component.
            if self._trust.height(Reading.TOF) and self.config.velocity_frame != "body" and not self.config.literal:
                ranged_m_s = climb(before, sample, self.config.velocity_step_m_s)
            self._filter.add_telemetry(sample, self.metres.fit.shortfall_m_s, ranged_m_s)

    def add_imu(self, readings: Sequence[ImuReadings]) -> None:
        """IMU readings in temporal order."""
        self.imu.add(readings)

    def add_visual(
        self, stamp_s: float, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float, tracked: bool = True
    ) -> None:
        """Pose of one frame in the map; delay, alignment and scale are fitted again when enough time has passed.

        Args:
            stamp_s: Stamp of the frame.
            T_w_c: Camera to map ``(4, 4)`` [map units].
            sigma_t: Standard deviation of its translation per axis [map units].
            sigma_r_rad: Standard deviation of its rotation per axis.
            tracked: False when the pose does not rest on this frame's image (predicted, lost): it is no measurement.
        """
        if not tracked or not np.isfinite(T_w_c).all():
            self._memory.interrupt()
            self._counts["visual not tracked"] += 1
            return
        last = self._memory.last
        if last is not None and stamp_s <= last.stamp_s:
            self._counts["visual out of order"] += 1
            return
        visual = VisualPose(stamp_s, np.array(T_w_c, dtype=np.float64), sigma_t, sigma_r_rad, self._memory.piece)
        self._memory.add(visual)
        if self._is_due(stamp_s) or (stamp_s - self._fitted_s >= _FIRST_FIT_S and self.orientation.has_diverged()):
            self._remember_refined(stamp_s, WINDOW_S)
            self._refit()
        if self.imu.is_due(stamp_s):
            self._remember_refined(stamp_s, IMU_REACH_S)
            self._fit_imu()
        if self._trust.motion and self.metres.uses_velocity(self._trust):
            self._filter.see(visual, self.metres.scale(), self.flight.delay.delay)
        else:
            self._filter.clear()

    def add_earlier(self, stamps_s: FloatArray, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float) -> None:
        """Add the frames on which a new submap rests, from before its first tracked one.

        Args:
            stamps_s: Their stamps ``(F,)``, increasing.
            T_w_c: Their poses ``(F, 4, 4)`` in the map.
            sigma_t: As for `add_visual`.
            sigma_r_rad: Likewise.
        """
        self._begun = None
        for stamp_s, T in zip(stamps_s.tolist(), T_w_c, strict=True):
            last = self._memory.last
            if np.isfinite(T).all() and (last is None or stamp_s > last.stamp_s):
                self._memory.add(VisualPose(stamp_s, T, sigma_t, sigma_r_rad, self._memory.piece))
        self._fit_imu()

    def revise(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        """Replace earlier poses by refined ones.

        Args:
            stamps_s: Stamps of frames ``(F,)``, as given to `add_visual`; others are ignored.
            T_w_c: Their poses ``(F, 4, 4)`` in the present map.
        """
        self._remember(stamps_s, T_w_c)
        self._refit(flying=False)
        self._fit_imu(whole=True)

    def _fit_imu(self, whole: bool = False) -> None:
        """Align the IMU with the poses of the camera's submap."""
        shown = self._memory.newest()
        self.imu.fit(shown.stamps_s, shown.T, whole)
        self.metres.inertial = self.imu.scale

    def _remember_refined(self, stamp_s: float, reach_s: float) -> None:
        """Update the poses of the last seconds to the present map."""
        if self.refined_poses is not None:
            self._remember(*self.refined_poses(stamp_s - reach_s))

    def _remember(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        self._memory.revise(stamps_s, T_w_c)
        if (seen := self._filter.seen) is not None:
            self._filter.move_map(seen.revised(dict(zip(stamps_s.tolist(), T_w_c, strict=True))))

    def map_moved(self, T: FloatArray) -> None:
        """Apply a correction of the map around the newest frame, ``T_w_c' = T T_w_c`` with ``(4, 4)``."""
        self._memory.move_newest(T)
        if (seen := self._filter.seen) is not None:
            self._filter.move_map(seen.moved(T))

    def begin_piece(self, piece: int, stamp_s: float, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float) -> None:
        """Begin a submap at a predicted pose: the step between submaps is no motion of the camera.

        The submap has a scale and a heading of its own, by predicted depths and motion, which sensors measure.
        Arguments as for `add_visual`, and the submap's number.
        """
        self._begun = VisualPose(stamp_s, T_w_c, sigma_t, sigma_r_rad, piece)
        before = self.metres.sensor_scale if self.submap is None else self.submap.before
        self.enter(piece)
        self._memory.interrupt()
        if before is not None:
            self.submaps[piece] = SubmapScale(before)

    @property
    def piece(self) -> int:
        """Number of the camera's submap."""
        return self._memory.piece

    @property
    def submap(self) -> SubmapScale | None:
        """Scale of the camera's submap, if it is not the map's."""
        return self.submaps.get(self._memory.piece)

    def enter(self, piece: int) -> None:
        """The camera is in a submap from now on, by its number: a new one, or one that it has returned to."""
        if piece != self._memory.piece:
            self._filter.clear()
            if self._memory.last is not None:
                self.imu.enter_submap(self._memory.last.stamp_s)
            self._memory.enter(piece)
            self._fitted_s = -math.inf

    def join(self, piece_of: Callable[[int], int]) -> None:
        """Submaps were merged: ``piece_of`` returns the present number of each. The whole is of the map's unit if one
        of them was."""
        of_one_unit = {piece_of(piece) for piece in self._memory.pieces - self.submaps.keys()}
        self.submaps = {
            piece: known
            for piece, known in self.submaps.items()
            if piece_of(piece) == piece and piece not in of_one_unit
        }
        self._memory.join(piece_of)

    def follow_start(self, stamp_s: float, T_w_c: FloatArray) -> None:
        """A frame's pose ``(4, 4)`` in a submap that has no map yet: no measurement, but where the camera is."""
        if self._begun is not None:
            self._begun = replace(self._begun, stamp_s=stamp_s, T=T_w_c)

    # --- output --------------------------------------------------------------------------------------------------

    @property
    def delay_s(self) -> float:
        """Video delay behind telemetry [s]: configured, estimated, or the default while unknown."""
        return self.flight.delay_s

    def scale(self) -> ScaleEstimate:
        """Metres per map unit around the newest frame, with sigma and source; unchanged without new measurements."""
        known = self.metres.scale()
        if self.submap is None:
            return known
        own = self.submap.sigma
        return replace(known, sigma=math.hypot(known.sigma, own * known.value))

    @property
    def filtering(self) -> bool:
        """Whether the Kalman filter receives visual updates and predicts the camera."""
        return self._filter.seen is not None

    def predict(self, stamp_s: float) -> PoseEstimate | None:
        """Camera pose at a frame's stamp by the filter, in the map; None while it has no scale or delay, and where
        telemetry has a gap or contradicts the images."""
        last = self._memory.last
        view = self._filter.view(stamp_s) if last is not None and stamp_s > last.stamp_s else None
        return None if view is None else view.in_map(self.scale(), self.flight.delay_sigma_s)

    @property
    def begun(self) -> PoseEstimate | None:
        """The newest pose in a submap that has no map yet, with the uncertainty of its beginning; None in any other."""
        begun, last = self._begun, self._memory.last
        if begun is None or (last is not None and begun.stamp_s <= last.stamp_s):
            return None
        return PoseEstimate(begun.T, begun.sigma_t, begun.sigma_r_rad)

    @property
    def has_unit(self) -> bool:
        """Whether velocities or heights have measured the map's unit, to which later submaps are brought."""
        return len(self.submaps) > 0 or self.metres.sensor_scale is not None

    def up(self) -> Up | None:
        """The vertical in the map, by the IMU or by an attitude that the images do not contradict."""
        for source, found in (("imu", self.imu.up), ("telemetry", self.orientation.up)):
            if found is not None:
                return Up(*found, source)
        return None

    def republished(self, published: OutputFrame) -> OutputFrame:
        """The published frame, levelled and with the present scale; as it is where a submap has a scale of its own."""
        if self.submap is not None:
            return published
        upright, by_imu = self.orientation.upright(), self.imu.upright()
        validated = self._trust.turns if upright is not None else by_imu is not None
        return published.turned_upright(by_imu if upright is None else upright, validated).revised(self.scale())

    def present(
        self, stamp_s: float, state: str, published: OutputFrame, submap_sigma: float = 0.0, drift_sigma: float = 0.0
    ) -> Present:
        """State after a frame: the motion, and the reliability of its scale.

        Args:
            stamp_s: Stamp of the frame.
            state: State of the machine.
            published: Published frame of the map.
            submap_sigma: As in `Health`.
            drift_sigma: As in `Health`.
        """
        known = self.health(stamp_s, state, published.is_metric(self.scale()))
        health = replace(known, submap_sigma=submap_sigma, drift_sigma=drift_sigma)
        return Present(self.snapshot(), published, health.metric, health)

    def health(self, stamp_s: float, state: str, metric: bool) -> Health:
        """Reliability of the scale; arguments as in `present`, and whether the published unit is a metre."""
        sources, delay, scale = self.metres.sources(), self.flight.delay.delay, self.scale()
        doubt = self.metres.contradiction()
        return Health(
            stamp_s,
            state,
            metric,
            scale,
            sources,
            disagreement(sources),
            stamp_s - self._track.last_s,
            delay.value_s if math.isfinite(delay.sigma_s) else math.nan,
            delay.sigma_s,
            self._track.battery,
            self.filtering,
            (*self._trust.warnings(), *([] if doubt is None else [doubt])),
        )

    def snapshot(self) -> Snapshot | None:
        """Present motion, for other threads; ``None`` before the first tracked frame."""
        last, previous = self._memory.last, self._memory.previous
        if last is None:
            return None
        if self._begun is not None and self._begun.stamp_s > last.stamp_s:
            last, previous = self._begun, None
        frozen = self._filter.frozen(), self.imu.frozen()
        return Snapshot(last, previous, *frozen, self.scale(), self.flight.delay_sigma_s)

    def statistics(self) -> dict[str, float]:
        """Counters and the state of the estimates, for the report."""
        numbers: dict[str, float] = dict(self._counts)
        numbers.update({f"ekf {k}": v for k, v in self._filter.ekf.statistics().items()})
        numbers["telemetry samples"] = len(self._track)
        numbers["telemetry refused"] = self._track.refused
        numbers["displacements"] = self._memory.count
        numbers["video delay s"] = self.delay_s
        numbers["video delay sigma s"] = self.flight.delay_sigma_s
        numbers.update({f"agreement {reading}": found.share for reading, found in self._trust.latest.items()})
        numbers["camera mount turned deg"] = math.degrees(self.orientation.mount_turned_rad)
        return numbers | self.metres.statistics() | self.imu.statistics()

    def warnings(self) -> list[str]:
        """Warnings of a rejected depth network or rejected telemetry."""
        return self._trust.warnings() + self._track.warnings() + self.metres.warnings() + self.imu.warnings()

    def turned(self, from_s: float, to_s: float) -> FloatArray | None:
        """Rotation ``R_c1_c0`` ``(3, 3)`` of the camera between two frames, by a gyroscope or by validated attitude."""
        by_gyroscope = self.imu.turned(from_s, to_s)
        if by_gyroscope is not None or not self._trust.turns:
            return by_gyroscope
        return turned(self._track, from_s - self.delay_s, to_s - self.delay_s, self.orientation.T_b_c[:3, :3])

    def telemetry(self) -> TelemetryModel | None:
        """Present telemetry and its alignment with the map, for refinement; None without any.

        Before the metric scale is known only gravity is used, and only if the map began upright: `Orientation.R_w_m` is
        a mean over attitudes and would include the map's own tilt.
        """
        model = self._model()
        return None if model is None else replace(model, track=self._track.copy())

    def _model(self) -> TelemetryModel | None:
        """The same without a copy of the track, for immediate use."""
        scale, orientation = self.metres.sensor_scale, self.orientation
        R_w_m = orientation.R_w_m if scale is not None else np.eye(3) if orientation.began_upright else None
        if R_w_m is None:
            return None
        there = self._track.heights()
        heights = [reading for reading in HEIGHTS if reading in there and self._trust.height(reading)]
        return TelemetryModel(
            self._track,
            self.config,
            orientation.given if scale is None else orientation.T_b_c,
            R_w_m,
            self.delay_s,
            self.flight.delay_sigma_s,
            1.0 if scale is None else math.exp(scale.log_scale),
            math.inf if scale is None else scale.sigma,
            self.metres.uses_velocity(self._trust),
            heights[0] if scale is not None and heights and "height" not in self.metres.decided.rejected else None,
            self.metres.fit.truncates,
            self._trust.attitude,
            mount_sigma_rad=MOUNT_RAD if orientation.found is None else float(orientation.found.sigma_rad[:2].max()),
            turns=self._trust.turns,
            gain_sigma=self._trust.gain_sigma,
        )

    # --- estimation ----------------------------------------------------------------------------------------------

    @property
    def _track(self) -> TelemetryTrack:
        return self.flight.track

    @property
    def _memory(self) -> VisualMemory:
        return self.flight.memory

    @property
    def _trust(self) -> SensorGate:
        return self.flight.trust

    def _is_due(self, stamp_s: float) -> bool:
        known = self.metres.sensor_scale is not None and math.isfinite(self.flight.delay_sigma_s)
        first_s = _REFIT_S if known else _FIRST_FIT_S
        began = self.submap is not None and not self.submap.is_known
        # A scale that the last fit did not determine is looked for again soon, and ever more rarely.
        grown_s = _REFIT_SHARE * min(self._memory.length_s, WINDOW_S, math.inf if known else stamp_s - self._known_s)
        pause_s = first_s if began else max(first_s, grown_s)
        return len(self._track) > 0 and (self.orientation.found is None or stamp_s - self._fitted_s >= pause_s)

    def _refit(self, flying: bool = True) -> None:
        """Fit delay, alignment, gates and scale."""
        last, orientation, metres = self._memory.last, self.orientation, self.metres
        if last is None or len(self._track) == 0:
            return
        self._fitted_s = last.stamp_s
        if orientation.found is None:
            orientation.found = orientation.fitted()
        self._search_delay()
        turned = orientation.fitted()
        if turned is None:
            return
        orientation.found = turned
        if self._trust.turns:
            self._memory.R_w_piece[self._memory.piece] = turned.R_w_m
        T_b_c, rough = orientation.T_b_c, metres.rough()
        self._comparison.judge(T_b_c, turned.R_w_m, rough, flying)
        piece = self._memory.piece
        if piece in self.submaps:  # what it measures says nothing of the map before it
            own = replace(self.flight, memory=self._memory.of({piece}), trust=deepcopy(self._trust))
            if len(own.memory.sightings().stamps_s) > 0:
                found, _ = TelemetryScale(own, T_b_c, turned, rough, None, None, flying).beliefs()
                if found is not None:
                    self.submaps[piece] = replace(self.submaps[piece], measured=mean(list(found.values())))
            return
        of_one_unit = self._memory.of(self._memory.pieces - self.submaps.keys()) if self.submaps else self._memory
        flight = replace(self.flight, memory=of_one_unit)
        scale = TelemetryScale(flight, T_b_c, turned, rough, metres.network(), metres.previous_scale(), flying)
        metres.take(*scale.beliefs(), self._trust)
        if metres.sensor_scale is not None:
            self._known_s = last.stamp_s

    def _search_delay(self) -> None:
        guessed = not math.isfinite(self.flight.delay_sigma_s)
        self.flight.delay.search(self._memory, self._track)
        if guessed and math.isfinite(self.flight.delay_sigma_s):  # heights were compared with a wrong delay
            for reading in HEIGHTS:
                self._trust.forget(reading)
