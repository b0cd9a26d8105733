"""What telemetry knows about the map: metric scale, gravity, video delay, and where the camera is without vision.

`MotionFusion` holds what is remembered and asks the rooms: `delay`, `alignment`, `comparison` (is it this flight's
telemetry?), `telemetry_scale`, `filter_feed` and `prediction`. Nothing is worked out by reading a result: each tracked
frame may bring a fit, and what it found stands until the next.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.dead_reckoning import REACH_S as RECKONED_S
from edgeslam_torch.fusion.dead_reckoning import Reckoned, reckoned
from edgeslam_torch.fusion.displacement import DELAY_S, TelemetryModel, is_steady
from edgeslam_torch.fusion.filter.filter_feed import FilterFeed, Metric
from edgeslam_torch.fusion.health import disagreement
from edgeslam_torch.fusion.prediction import (
    VISUAL_REACH_S,
    Carried,
    PoseEstimate,
    between,
    by_filter,
    by_vision,
    with_velocity,
)
from edgeslam_torch.fusion.published import Published
from edgeslam_torch.fusion.scale.camera_mount import Mount, Turned, estimate_mount, mount_by_turns
from edgeslam_torch.fusion.scale.consensus import Settled, settled_with_network
from edgeslam_torch.fusion.scale.depth_scale import DepthRatio, DepthRatios, DepthScale
from edgeslam_torch.fusion.scale.log_scale import LogScale, fuse
from edgeslam_torch.fusion.snapshot import Present, Snapshot
from edgeslam_torch.fusion.telemetry.alignment import attitudes, map_to_world
from edgeslam_torch.fusion.telemetry.comparison import Comparison, FlightSoFar
from edgeslam_torch.fusion.telemetry.delay import DelaySearch
from edgeslam_torch.fusion.telemetry.grown import REACH_S, grown
from edgeslam_torch.fusion.telemetry.local_scale import drift_in_words, scale_around, scale_of
from edgeslam_torch.fusion.telemetry.plausibility import HEIGHTS, Trust
from edgeslam_torch.fusion.telemetry.track import TelemetryTrack
from edgeslam_torch.fusion.telemetry.unrest import Unrest
from edgeslam_torch.fusion.telemetry.visual_memory import VisualMemory, VisualPose
from edgeslam_torch.fusion.telemetry_scale import TelemetryFit, TelemetryScale
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.types import FloatArray, Health, ScaleEstimate, TelemetrySample

_REFIT_S = 1.0
_FIRST_FIT_S = 0.5
"""Time from one fit to the next as long as telemetry has told no scale or no delay: a displacement's length."""
_REFIT_SHARE = 0.12
"""Each fit costs more and changes less than the one before."""
_BELIEVED = 0.3
"""Relative sigma of a scale from telemetry that is used."""
_SURE = 0.15
"""Relative sigma of a scale by heights alone by which velocities pull at the map: half of what is believed, so that two
sigmas are a third and not more than a half. A scale that is wrong by several times tears the map by them."""
_TURNED_S = 5.0
"""Time over which the map and the drone's attitude have turned together: maps drift by a degree in it."""
_USUAL_SIGMA = 0.01
"""Standard deviation of a visual pose whose own is not known any more [map units, rad]."""
_AT_ONCE_S = 0.5
"""Time from the first frame in which the first attitude comes if it comes at all: five messages."""
_STAMPED_S = 0.05
"""Standard deviation of a message's moment: half of the time from one to the next."""
_FOCAL_SHARE = 0.4
"""How much of a focal length's error the scale from telemetry takes on: with 0.7 to 1.5 times the right one the root
mean square over fr1_xyz, redkitchen and euroc_mh05_a is 0.4 in the logarithm."""


class MotionFusion:
    """Ties the visual map to the drone's telemetry; `EdgeSlam` calls it for every frame and every packet.

    The map may be in any gauge: ``T_w_c`` in arbitrary units and axes, as long as they stay the same.
    A frame stamped ``t`` shows what telemetry reported at ``t - delay``.

    Args:
        config: Settings.
        T_b_c: Camera in the body frame ``(4, 4)`` [m]; for a Tello tilted down by some 12 degrees.
        focal_sigma: Relative standard deviation of the camera's focal length; a wrong one bends the map and its scale.
    """

    def __init__(self, config: FusionConfig, T_b_c: FloatArray, focal_sigma: float = 0.0) -> None:
        self.config = config
        self.T_b_c = np.asarray(T_b_c, dtype=np.float64)
        self.refined_poses: Callable[[float], tuple[FloatArray, FloatArray]] | None = None
        """Gives stamps and poses of the frames since a stamp, in the map as it is now; asked before each fit."""
        self._focal_sigma = focal_sigma
        self._track = TelemetryTrack(config.velocity_frame, config.max_gap_s)
        self._memory = VisualMemory(config.interval_s, config.window_s, config.max_gap_s)
        self._depth = DepthRatios(self.config.depth_bias_log)
        self._delay = DelaySearch(config, self.T_b_c[:3, :3])
        self._comparison = Comparison(config)
        self._filter = FilterFeed(config, self.T_b_c)
        self._trust = Trust()
        self._unrest = Unrest()
        self._turned: Turned | None = None
        """How map and camera are turned against the drone and its world; None without telemetry attitude."""
        self.began_s = math.nan
        """Stamp of the first frame."""
        self._attitude_s = math.inf
        """Stamp of the first message with an attitude."""
        self.began_upright = False
        """Whether the map's z axis is up: its first camera was turned so by the drone's attitude."""
        truncates = config.velocity_rounding == "truncate"
        self._fit = TelemetryFit(shortfall_m_s=0.5 * config.velocity_step_m_s if truncates else 0.0)
        self._guess: ScaleEstimate | None = None
        """Scale by heights that nothing has proven to be of this flight yet."""
        self._remembered: LogScale | None = None
        """Scale of a map that an earlier flight made."""
        self._by_telemetry: LogScale | None = None
        """Scale by the drone's own sensors; held while they say nothing new."""
        self._scale = ScaleEstimate()
        self._scale_rests_on: tuple[LogScale | None, LogScale | None, DepthScale | None] = (None, None, None)
        """Opinions that it was made of: it is asked for several times a frame."""
        self._drift: str | None = None
        """That parts of the map have different scales, in words."""
        self._fitted_s = self._followed_s = -math.inf
        """Stamps at which it was last fitted, and last followed the map between fits."""
        self._counts: Counter[str] = Counter()

    # --- input ---------------------------------------------------------------------------------------------------

    def add_telemetry(self, samples: Sequence[TelemetrySample]) -> None:
        """State messages in the order of arrival."""
        for sample in self._track.add(samples):
            if np.isfinite(sample.rpy_rad).all():
                self._attitude_s = min(self._attitude_s, sample.stamp_s)
            self._filter.add_telemetry(sample, self._fit.shortfall_m_s)

    def add_visual(
        self, stamp_s: float, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float, tracked: bool = True
    ) -> None:
        """Pose of one frame in the map; delay, alignment and scale are fitted again when enough time has passed.

        Args:
            stamp_s: Stamp of the frame.
            T_w_c: Camera to map ``(4, 4)`` [map units].
            sigma_t: Standard deviation of its translation per axis [map units].
            sigma_r_rad: Standard deviation of its rotation per axis.
            tracked: False when the pose does not rest on this frame's image (predicted, lost): it is then no evidence.
        """
        if not tracked or not np.isfinite(T_w_c).all():
            self._memory.interrupt()
            self._counts["visual not tracked"] += 1
            return
        last = self._memory.last
        if last is not None and stamp_s <= last.stamp_s:
            self._counts["visual out of order"] += 1
            return
        visual = VisualPose(stamp_s, np.array(T_w_c, dtype=np.float64), sigma_t, sigma_r_rad)
        self._memory.add(visual)
        if self._is_due(stamp_s):
            self._remember_refined(stamp_s, self.config.window_s)
            self._refit()
        elif self._by_telemetry is not None and stamp_s - max(self._fitted_s, self._followed_s) >= _REFIT_S:
            self._follow_map(self._by_telemetry, stamp_s)
        if self._trust.velocity and self._trust.motion:
            self._filter.see(visual, Metric(self.scale(), self._delay.delay))
        else:
            self._filter.clear()

    def _follow_map(self, told: LogScale, stamp_s: float) -> None:
        """Take the scale along with a map that refinement has enlarged since the last fit."""
        self._followed_s = stamp_s
        before = self._memory.displacements()
        self._remember_refined(stamp_s, REACH_S)
        log_ratio = math.log(grown(before, self._memory.displacements(), stamp_s))
        self._by_telemetry = replace(told, log_scale=told.log_scale - log_ratio)

    def add_earlier(self, stamps_s: FloatArray, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float) -> None:
        """Frames on which a new piece of map rests, before its first tracked one: they have moved with the drone, too.

        Args:
            stamps_s: Their stamps ``(F,)``, increasing.
            T_w_c: Their poses ``(F, 4, 4)`` in the map.
            sigma_t: As for `add_visual`.
            sigma_r_rad: Likewise.
        """
        for stamp_s, T in zip(stamps_s.tolist(), T_w_c, strict=True):
            last = self._memory.last
            if np.isfinite(T).all() and (last is None or stamp_s > last.stamp_s):
                self._memory.add(VisualPose(stamp_s, T, sigma_t, sigma_r_rad))

    def revise(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        """Later knowledge of earlier poses: a map that was refined has moved them, and its scale has drifted less.

        Args:
            stamps_s: Stamps of frames ``(F,)``, as given to `add_visual`; others are left alone.
            T_w_c: Their poses ``(F, 4, 4)`` in the map as it is now.
        """
        self._remember(stamps_s, T_w_c)
        self._refit(flying=False)

    def _remember_refined(self, stamp_s: float, reach_s: float) -> None:
        """Poses of the last seconds as the map has them now, and how much that changes."""
        if self.refined_poses is None:
            return
        before = self._memory.sightings()
        self._remember(*self.refined_poses(stamp_s - reach_s))
        self._unrest.compare(before, self._memory.sightings(), stamp_s)

    def _remember(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        self._memory.revise(stamps_s, T_w_c)
        if (seen := self._filter.seen) is not None:
            self._filter.move_map(seen.revised(dict(zip(stamps_s.tolist(), T_w_c, strict=True))))

    def map_moved(self, T: FloatArray) -> None:
        """The map around the newest frame was moved, ``T_w_c' = T T_w_c`` with ``(4, 4)``; the camera was not."""
        self._memory.move_newest(T)
        if (seen := self._filter.seen) is not None:
            self._filter.move_map(seen.moved(T))

    def begin_piece(self) -> None:
        """A new piece of map begins at a predicted pose: what moves between the pieces is not the camera."""
        self._filter.clear()
        self._memory.interrupt()

    def add_depth_ratio(self, ratio: DepthRatio) -> None:
        """How one keyframe's network depth compares with the map's."""
        self._depth.add(ratio)

    def replace_depth_ratios(self, ratios: Sequence[DepthRatio]) -> None:
        """The same of all keyframes, once the map has another unit."""
        self._depth = DepthRatios(self.config.depth_bias_log)
        for ratio in ratios:
            self._depth.add(ratio)

    def remember(self, scale: ScaleEstimate | None) -> None:
        """Metres per unit of the map that the camera is in, as an earlier flight left them; None for a map of its own.

        They take the place of the depth network's opinion: its error in a place is the same in every flight.
        """
        if scale is None or not math.isfinite(scale.sigma):
            self._remembered = None
        else:
            self._remembered = LogScale(math.log(scale.value), scale.sigma / scale.value, "atlas")

    def _forget_scale(self) -> None:
        self._by_telemetry, self._fit = None, TelemetryFit(shortfall_m_s=self._fit.shortfall_m_s)

    # --- output --------------------------------------------------------------------------------------------------

    @property
    def delay_s(self) -> float:
        """Video delay behind telemetry [s]: configured, estimated, or the guess while nothing is known."""
        return self._delay.delay.value_s

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of `delay_s`; infinite while it is a guess, 0 when configured."""
        return self._delay.delay.sigma_s

    def scale(self) -> ScaleEstimate:
        """Metres per map unit with sigma and source; held while the motion says nothing new."""
        rests_on = self._remembered, self._by_telemetry, self._depth.scale()
        if rests_on != self._scale_rests_on:
            self._scale_rests_on, self._scale = rests_on, fuse(self._settled().used)
        return self._scale

    def guess(self) -> ScaleEstimate | None:
        """Metres per map unit by a climb before anything has proven that telemetry is of this flight; None after that.

        No claim of metres: a better guess of the published unit than the depth network's.
        """
        return self._guess

    def scale_around(self, stamp_s: float) -> ScaleEstimate | None:
        """Metres per map unit within seconds of an earlier frame, in the map as it is now; None where nothing tells."""
        if self._turned is None or not self._trust.velocity or len(self._track) == 0:
            return None
        moved, low = self._memory.displacements(), self._fit.shortfall_m_s
        return scale_around(
            moved, self._track, stamp_s, self.delay_s, self._turned.R_w_m, self._mounted, self.config, low
        )

    def scale_along(self, stamps_s: FloatArray, T_w_c: FloatArray) -> ScaleEstimate | None:
        """Metres per map unit along some frames of the flight, ``(F,)`` and ``(F, 4, 4)``; None where nothing tells."""
        R_w_m = self.rotation()
        if R_w_m is None or not self._trust.velocity or len(self._track) == 0 or len(stamps_s) == 0:
            return None
        length_s = float(stamps_s[-1] - stamps_s[0]) + self.config.window_s
        memory = VisualMemory(self.config.interval_s, length_s, self.config.max_gap_s)
        for stamp_s, T in zip(stamps_s.tolist(), T_w_c, strict=True):
            memory.add(VisualPose(stamp_s, T, _USUAL_SIGMA, _USUAL_SIGMA))
        moved, low = memory.displacements(), self._fit.shortfall_m_s
        return scale_of(moved, self._track, self.delay_s, R_w_m, self._mounted, self.config, low)

    def network_unit(self) -> float | None:
        """The depth network's metres per map unit, right or wrong; None before anything has been compared."""
        depth = self._depth.scale()
        return None if depth is None else math.exp(depth.log_scale)

    def _settled(self) -> Settled:
        """Opinions that may be averaged."""
        told, depth = self._by_telemetry, self._depth.scale()
        if told is not None:
            told = replace(told, sigma=math.hypot(told.sigma, _FOCAL_SHARE * self._focal_sigma))
        network = None if depth is None else self._with_focal(depth)
        if self._remembered is not None:  # which the network has had its part in
            return settled_with_network(told, self._remembered, True)
        return settled_with_network(told, network, depth is not None and depth.in_domain)

    def _with_focal(self, depth: DepthScale) -> LogScale:
        """Map depth, and the network's metres, go with the focal length: its whole uncertainty is the ratio's too."""
        return replace(depth.opinion, sigma=math.hypot(depth.sigma, self._focal_sigma))

    def vertical(self, stamp_s: float) -> tuple[FloatArray, float] | None:
        """The map's z axis ``(3,)`` in a frame's camera by the drone's attitude, and how far [rad] that leaned within
        the doubt about the video's delay; None where attitude is not to be asked, or metres are told: whole degrees
        are worse than what a map with parallax says."""
        at_s = np.array([stamp_s - self.delay_s])
        asked = self._by_telemetry is None and self.began_upright and self._trust.attitude
        if not asked or not self._track.covered(at_s, at_s)[0]:
            return None
        if not (self._trust.turns or is_steady(self._track, at_s)[0]):
            return None
        leaned = self._track.leaned(at_s, min(self.delay_sigma_s, DELAY_S))
        return self.T_b_c[:3, :3].T @ self._track.attitude(at_s)[0, 2], float(leaned[0])

    def told(self, stamp_s: float) -> tuple[tuple[FloatArray, float] | None, Reckoned | None]:
        """What `turned` and `reckoned` say of a frame."""
        return self.turned(stamp_s), self.reckoned(stamp_s)

    def turned(self, stamp_s: float) -> tuple[FloatArray, float] | None:
        """Rotation ``R_c_m`` ``(3, 3)`` of a frame's camera by the drone's attitude, turned into the map as the last
        seconds' frames were, and how far [rad] it turned within the doubt about the video's delay; None where
        telemetry has not proven to be of this flight, or the map is too young."""
        late_s = math.hypot(self.delay_sigma_s, _STAMPED_S)
        around = stamp_s - self.delay_s + np.array([0.0, -late_s, late_s])
        if not (self._trust.turns and math.isfinite(late_s) and self._track.covered(around[:1], around[:1])[0]):
            return None
        recent = self._memory.recent(stamp_s - _TURNED_S)
        if recent is None:
            return None
        R_w_m = map_to_world(recent, self._track, self.delay_s, self._mounted[:3, :3])
        if R_w_m is None:
            return None
        R_m_c = R_w_m.T @ self._track.attitude(around) @ self._mounted[:3, :3]
        doubt = max(float(np.linalg.norm(rotation_vector(R_m_c[0].T @ R_m_c[k]))) for k in (1, 2))
        return R_m_c[0].T, doubt

    def reckoned(self, stamp_s: float) -> Reckoned | None:
        """Place of a frame's camera by dead reckoning; None where telemetry tells no metres, its velocities have not
        proven to be of this flight, or the metres that are told do not rest on them: in the wrong unit they carry the
        camera ten times too far beside heights that nothing has compared with them yet."""
        told = self._by_telemetry
        if told is None or "telemetry" not in told.source:
            return None
        model, recent = self._model(), self._memory.recent(stamp_s - RECKONED_S)
        if model is None or recent is None or not (model.velocity and math.isfinite(model.delay_sigma_s)):
            return None
        return reckoned(model, recent, stamp_s)

    def rotation(self) -> FloatArray | None:
        """``R_w_m`` ``(3, 3)``: map axes to the drone's power-on world; ``None`` without telemetry attitude."""
        return None if self._turned is None else self._turned.R_w_m

    @property
    def _mounted(self) -> FloatArray:
        """Camera in the body ``(4, 4)`` as the flight's turns have it."""
        if self._turned is None:
            return self.T_b_c
        T_b_c = self.T_b_c.copy()
        T_b_c[:3, :3] = self._turned.R_b_c
        return T_b_c

    @property
    def filtering(self) -> bool:
        """Whether the Kalman filter is fed by vision: it then predicts the camera."""
        return self._filter.seen is not None

    def predict(self, stamp_s: float) -> PoseEstimate | None:
        """Camera pose at a frame's stamp from what vision saw last and what telemetry has told since.

        Returns:
            The estimate in map units, or ``None`` before the first tracked frame.
        """
        last, previous = self._memory.last, self._memory.previous
        if last is None:
            return None
        view = self._filter.view(stamp_s) if stamp_s > last.stamp_s else None
        if view is not None:
            told = by_filter(view, self.scale(), self.delay_sigma_s)
            return with_velocity(told, last, previous, self.scale())
        return self._predict_unfiltered(last, previous, stamp_s)

    def sources(self) -> tuple[ScaleEstimate, ...]:
        """Scale by each source alone, used or not."""
        told = [ScaleEstimate(s.value, s.sigma, name) for name, s in self._fit.sources.items()]
        depth = self._depth.scale()
        if depth is not None:
            value = math.exp(depth.opinion.log_scale)
            told.append(ScaleEstimate(value, value * self._with_focal(depth).sigma, "depth"))
        if (known := self._remembered) is not None:
            value = math.exp(known.log_scale)
            told.append(ScaleEstimate(value, value * known.sigma, known.source))
        return tuple(told)

    def republished(self, published: Published, centre_map: FloatArray) -> Published:
        """What is published, upright and in the unit that is known or guessed now; ``centre_map`` ``(3,)`` stays where
        it is."""
        published = published.turned_upright(self._up_by_attitude(), centre_map)
        return published.guessed_anew(self._guess, centre_map).revised(self.scale(), centre_map)

    def _up_by_attitude(self) -> FloatArray | None:
        """``R_w_m`` where attitude may turn the world: when it has proven to be of this flight, or as the one may that
        comes with the first picture."""
        if self._turned is None or not self._trust.attitude:
            return None
        at_once = self._attitude_s - self.began_s < _AT_ONCE_S
        return self._turned.R_w_m if at_once or self._trust.turns else None

    def leaning(self) -> str | None:
        """That no attitude was sure enough to tell where up is, in words; None where the drone told none."""
        if not math.isfinite(self._attitude_s):
            return None
        return (
            "where up is was not known, the world leans as the first camera did: no attitude of the drone that came at "
            "once or has proven to be of this flight covers a picture with a pose (the first one came "
            f"{self._attitude_s - self.began_s:.1f} s after the first picture)"
        )

    def present(
        self, stamp_s: float, state: str, published: Published, apart_sigma: float = 0.0, drift_sigma: float = 0.0
    ) -> Present:
        """What is known after a frame: the motion, and the reliability of its metres.

        Args:
            stamp_s: Stamp of the frame.
            state: What carries its pose.
            published: What is published of the map.
            apart_sigma: As in `Health`.
            drift_sigma: As in `Health`.
        """
        known = self.health(stamp_s, state, published.is_metric(self.scale()))
        health = replace(known, apart_sigma=apart_sigma, drift_sigma=drift_sigma)
        return Present(self.snapshot(), published, health.metric, health)

    def health(self, stamp_s: float, state: str, metric: bool) -> Health:
        """Reliability of the metres; arguments as in `present`, and whether the published unit is a metre."""
        sources, delay, scale = self.sources(), self._delay.delay, self.scale()
        doubt = self._settled().warning
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
            tuple(self._trust.warnings() + [said for said in (doubt, self._drift) if said is not None]),
        )

    def snapshot(self) -> Snapshot | None:
        """What is known of the present motion, for other threads; ``None`` before the first tracked frame."""
        last = self._memory.last
        if last is None:
            return None
        return Snapshot(last, self._memory.previous, self._filter.frozen(), self.scale(), self.delay_sigma_s)

    def _predict_unfiltered(self, last: VisualPose, previous: VisualPose | None, stamp_s: float) -> PoseEstimate:
        """While the filter knows no scale or no delay, telemetry has a hole, or does not go with the images."""
        gap = stamp_s - last.stamp_s
        visual = by_vision(last, previous, stamp_s)
        share = 1.0 if previous is None else float(np.clip((gap - VISUAL_REACH_S) / VISUAL_REACH_S, 0.0, 1.0))
        if share == 0.0 or gap <= 0.0 or not self._trust.motion:
            return visual
        told = self._carried().on(last, stamp_s)
        return visual if told is None else between(visual, told, share)

    def _carried(self) -> Carried:
        sigma = self.config.sigma_velocity_m_s
        return Carried(self._track, self.delay_s, self._mounted, self.rotation(), self.scale(), self._fit, sigma)

    def mount(self) -> Mount | None:
        """How the camera sits on the body, estimated from the flight; ``None`` without enough motion."""
        if self._memory.count == 0 or len(self._track) < 2 or not self._trust.velocity:
            return None
        moved = self._memory.displacements().on_telemetry_clock(self.delay_s)
        use = self._track.covered(moved.from_s, moved.to_s)
        if not use.any():
            return None
        moved = moved.only(use)
        told = self._track.displacement(moved.to_s, self._fit.shortfall_m_s)
        told -= self._track.displacement(moved.from_s, self._fit.shortfall_m_s)
        return estimate_mount(
            np.einsum("nji,nj->ni", moved.R_from, moved.moved),
            np.einsum("nji,nj->ni", self._track.attitude(moved.from_s), told),
            moved.duration_s,
            moved.sigma,
            self.config.sigma_velocity_m_s,
            self.T_b_c[:3, :3],
        )

    def statistics(self) -> dict[str, float]:
        """Counters and the state of the estimates, for the report."""
        numbers: dict[str, float] = dict(self._counts)
        numbers.update({f"ekf {k}": v for k, v in self._filter.ekf.statistics().items()})
        numbers["telemetry samples"] = len(self._track)
        numbers["telemetry refused"] = self._track.refused
        numbers["displacements"] = self._memory.count
        numbers["video delay s"] = self.delay_s
        numbers["video delay sigma s"] = self.delay_sigma_s
        if self._fit.moved is not None:
            numbers["displacement residual m"] = self._fit.moved.rms_m
        numbers.update({f"agreement {reading}": found.share for reading, found in self._trust.latest.items()})
        mount = self.mount()
        if mount is not None:
            numbers["camera tilt deg"] = math.degrees(mount.tilt_rad)
            numbers["camera tilt sigma deg"] = math.degrees(mount.tilt_sigma_rad)
        turned = self._mounted[:3, :3] @ self.T_b_c[:3, :3].T
        numbers["camera mount turned deg"] = math.degrees(float(np.linalg.norm(rotation_vector(turned))))
        for name, source in self._fit.sources.items():
            numbers[f"scale {name}"], numbers[f"scale {name} sigma"] = source.value, source.sigma
        depth = self._depth.scale()
        if depth is not None:
            numbers |= depth.statistics()
        return numbers

    def warnings(self) -> list[str]:
        """What the depth network or telemetry tells that the images do not bear out, in sentences; it is not used."""
        depth, contradiction = self._depth.scale(), self._settled().warning
        own = (None if depth is None else depth.warning(), contradiction, self._drift)
        return self._trust.warnings() + self._track.warnings() + [said for said in own if said is not None]

    def telemetry(self) -> TelemetryModel | None:
        """Telemetry and its tie to the map as they are now, for refinement; None while there is none.

        Until its metres are known gravity alone speaks, if the map was begun upright: the mean of attitudes that
        `rotation` is has the map's own tilt in it by then (docs/decisions/0108).
        """
        model = self._model()
        return None if model is None else replace(model, track=self._track.copy())

    def _model(self) -> TelemetryModel | None:
        """The same on the track that grows, for use at once."""
        told = self._by_telemetry
        R_w_m = self.rotation() if told is not None else np.eye(3) if self.began_upright else None
        if R_w_m is None:
            return None
        there = self._track.heights()
        heights = [reading for reading in HEIGHTS if reading in there and self._trust.height(reading)]
        odds = self._trust.at_odds  # what is not used for the scale must not pull at the map either
        return TelemetryModel(
            self._track,
            self.config,
            self.T_b_c if told is None else self._mounted,
            R_w_m,
            self.delay_s,
            self.delay_sigma_s,
            1.0 if told is None else math.exp(told.log_scale),
            math.inf if told is None else told.sigma,
            self._velocity_speaks(told),
            heights[0] if told is not None and heights and (odds is None or odds.kept == "height") else None,
            self._fit.truncates,
            self._trust.attitude,
            self._trust.turns,
        )

    def _velocity_speaks(self, told: LogScale | None) -> bool:
        """Whether velocities may pull at the map: not by metres that heights alone told, and hardly know."""
        if told is None or not ("telemetry" in told.source or told.sigma < _SURE):
            return False
        odds = self._trust.at_odds
        return self._trust.velocity and (odds is None or odds.kept == "telemetry")

    # --- estimation ----------------------------------------------------------------------------------------------

    def _is_due(self, stamp_s: float) -> bool:
        known = self._by_telemetry is not None and math.isfinite(self.delay_sigma_s)
        first_s = _REFIT_S if known else _FIRST_FIT_S
        pause_s = max(first_s, _REFIT_SHARE * min(self._memory.length_s, self.config.window_s))
        return len(self._track) > 0 and (self._turned is None or stamp_s - self._fitted_s >= pause_s)

    def _refit(self, flying: bool = True) -> None:
        """Delay, alignment, trust and scale from what is remembered."""
        last = self._memory.last
        if last is None or len(self._track) == 0:
            return
        self._fitted_s = last.stamp_s
        if self._turned is None:
            self._turned = self._alignment()
        guessed = not math.isfinite(self.delay_sigma_s)
        self._delay.search(self._memory, self._track)
        if guessed and math.isfinite(self.delay_sigma_s):  # heights were compared at a wrong delay
            for reading in HEIGHTS:
                self._trust.forget(reading)
        turned = self._alignment()
        if turned is None:
            return
        self._turned = turned
        depth = self._depth.scale()
        network = None if depth is None else self._with_focal(depth)
        present = FlightSoFar(self._memory, self._track, self._mounted[:3, :3], self._rough_scale(), network)
        self._comparison.judge(self._trust, present, self._delay.delay, turned.R_w_m, flying)
        self._trust.at_odds = None
        held = self._held_scale()
        scale = TelemetryScale(self.config, self._mounted, present, self._trust, self.delay_s, turned, held, flying)
        unrest = self._unrest.sigma if flying else 0.0
        self._take(scale.opinion(), unrest)
        supposed = TelemetryScale(
            self.config, self._mounted, present, self._trust.supposing_heights(), self.delay_s, turned, held, flying
        )
        self._guess = self._guessed(supposed, unrest) if flying and self._by_telemetry is None else None
        oldest = self._memory.sightings().stamps_s[0]
        self._drift = drift_in_words(self.scale_around, float(oldest), last.stamp_s)

    @staticmethod
    def _guessed(supposed: TelemetryScale, unrest: float) -> ScaleEstimate | None:
        found = supposed.opinion()
        if found is None or not (sigma := math.hypot(found[0].sigma, unrest)) < _BELIEVED:
            return None
        value = math.exp(found[0].log_scale)
        return ScaleEstimate(value, value * sigma, found[0].source)

    def _take(self, found: tuple[LogScale, TelemetryFit] | None, unrest: float) -> None:
        if found is not None:
            self._fit = found[1]
        if found is not None and found[0].sigma < _BELIEVED:
            self._by_telemetry = replace(found[0], sigma=math.hypot(found[0].sigma, unrest))
        elif not self._still_trusted():
            self._forget_scale()
        # else nothing new to say: hover, pure rotation, or telemetry missing

    def _alignment(self) -> Turned | None:
        """By the flight's attitudes; the camera's mount only once they have turned as the images did."""
        told = attitudes(self._memory.sightings(), self._track, self.delay_s)
        if told is None:
            return None
        R_b_c, sigma_rad = self.T_b_c[:3, :3], self.config.alignment_sigma_rad
        if self._trust.turns:
            return mount_by_turns(told.R_m_c, told.R_w_b, told.stamp_s, R_b_c, sigma_rad)
        return Turned(R_b_c, told.map_to_world(R_b_c), np.full(3, sigma_rad))

    def _rough_scale(self) -> float | None:
        """Metres per map unit, for what counts as motion."""
        depth = self._depth.scale()
        return math.exp(depth.log_scale) if depth is not None else self._held_scale()

    def _held_scale(self) -> float | None:
        return None if self._by_telemetry is None else math.exp(self._by_telemetry.log_scale)

    def _still_trusted(self) -> bool:
        """Whether all that the held opinion rests on may still tell the scale."""
        trusted = {"telemetry": self._trust.velocity, "height": any(map(self._trust.height, HEIGHTS))}
        settled = self._trust.at_odds is None or self._trust.at_odds.kept is not None
        return settled and all(trusted[source] for source in self._fit.sources)
