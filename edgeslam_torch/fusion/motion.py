"""What telemetry knows about the map: metric scale, gravity, video delay, and where the camera is without vision."""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.delayed import BufferedEkf
from edgeslam_torch.fusion.ekf import EkfState
from edgeslam_torch.fusion.joint_scale import Evidence, displacement_evidence, height_evidence, solved
from edgeslam_torch.fusion.mount import Mount, estimate_mount
from edgeslam_torch.fusion.plausibility import Agreement, Reading, Trust, Verdict, agreement, changes
from edgeslam_torch.fusion.rotations import mean_rotation, rotation_vector
from edgeslam_torch.fusion.scale import DepthRatio, LogScale, floor_segments, fuse
from edgeslam_torch.fusion.track import TelemetryTrack
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, IntArray, ScaleEstimate, TelemetrySample

_DELAY_GUESS_S = 0.3
"""Used until the motion says better; the short end of what Tello owners measure."""
_REFIT_S = 1.0
_REFIT_SHARE = 0.12
_IMPROBABLE = 1e-4
_GOOD_HEIGHT = 0.2
"""Relative sigma with which a height source is good enough; the next one would say the same less well."""
_DELAY_STEP_S = 0.05
_MIN_DELAY_INTERVALS = 12
_WIDE_DELAYS_S = (-3.0, 3.0)
_WIDE_STEP_S = 0.1
"""Delays beyond those allowed are looked at where telemetry does not fit well: a wrong clock is said, not used."""
_FITS_WELL = 0.9
_MUCH_LIKELIER = 6.0
"""Log likelihood ratio; half the intervals count as independent."""
_LEAST_TURN_RAD_S = math.radians(2.0)
"""Whole degrees twice a second are noise below."""
_HEIGHT_BIN_S = 0.5
_MANY_INTERVALS = 16
_FEED_S = 0.09
"""The filter takes vision at the pace of telemetry: each late increment costs a re-propagation."""
_VISUAL_REACH_S = 0.15
"""The last visual velocity predicts better than 10 Hz readings of 0.1 m/s up to about here."""
_VISUAL_LIMIT_S = 0.5
"""Without telemetry, the camera is held where constant velocity puts it after this time."""
_FOCAL_SHARE = 0.4
"""How much of a focal length's error the scale from telemetry takes on: with 0.7 to 1.5 times the right one the root
mean square over fr1_xyz, redkitchen and euroc_mh05_a is 0.4 in the logarithm."""
_HEIGHT_SOURCES = {"tof": "sigma_tof_m", "h": "sigma_h_m", "baro": "sigma_baro_m"}
_LEAST_CLIMB_M = 0.05
_LEAST_CLIMB_SIGMAS = 2.0
_MOST_STEPS = 0.3
"""Share of height readings that may step: more is not furniture passing below."""
_AT_ODDS = 5.0
_AT_ODDS_LOG = math.log(2.0)
"""Sigmas and factor between the scales of velocities and height beyond which one of them is nonsense."""


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """Predicted camera pose in the map's own gauge."""

    stamp_s: float
    T_w_c: FloatArray
    """``(4, 4)``, map units."""
    sigma_t: float
    """Standard deviation of the translation per axis [map units]."""
    sigma_r_rad: float
    source: str
    """``visual``, ``telemetry`` or ``visual+telemetry``."""


@dataclass(slots=True)
class _Visual:
    stamp_s: float
    T: FloatArray
    sigma_t: float
    sigma_r_rad: float


@dataclass(slots=True)
class _Interval:
    """One visual displacement, kept until telemetry of the same time is there."""

    from_s: float
    to_s: float
    T_from: FloatArray
    T_to: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True)
class _Opinion:
    """Scale from velocity and height under one reading of the velocities."""

    log_scale: float
    sigma: float
    gap: float
    """How far velocity and height are apart, in sigmas of the difference."""
    moved: Evidence | None
    sources: dict[str, tuple[float, float]]
    """Scale and sigma of each on its own."""
    shortfall_m_s: float


class MotionFusion:
    """Ties the visual map to the drone's telemetry; `EdgeSlam` calls it for every frame and every packet.

    The map may be in any gauge: ``T_w_c`` in arbitrary units and axes, as long as they stay the same until `rescale`
    (or `reset_map`). A frame stamped ``t`` shows what telemetry reported at ``t - delay``.

    Args:
        config: Settings.
        T_b_c: Camera in the body frame ``(4, 4)`` [m]; for a Tello tilted down by some 12 degrees.
        focal_sigma: Relative standard deviation of the camera's focal length; a wrong one bends the map and its scale.
    """

    def __init__(self, config: FusionConfig, T_b_c: FloatArray, focal_sigma: float = 0.0) -> None:
        self.config = config
        self._focal_sigma = focal_sigma
        self.T_b_c = np.asarray(T_b_c, dtype=np.float64)
        self.refined_poses: Callable[[float], tuple[FloatArray, FloatArray]] | None = None
        """Gives stamps and poses of the frames since a stamp, in the map as it is now; asked before each fit."""
        self._track = TelemetryTrack(config.velocity_frame, config.max_gap_s)
        self._intervals: deque[_Interval] = deque(maxlen=max(20, int(config.window_s / config.interval_s)))
        self._sightings: deque[_Visual] = deque(maxlen=int(10 * config.window_s))
        """Tracked poses at some 10 Hz, for height and attitude."""
        self._start: _Visual | None = None
        self._previous: _Visual | None = None
        self._last: _Visual | None = None
        self._fed: _Visual | None = None
        """Pose at the filter's last visual update."""
        self._depth = self._new_depth_ratio()
        self._ekf = BufferedEkf(config)
        self._ekf_delay: float | None = None
        self._delay_s = _DELAY_GUESS_S if config.delay_s is None else config.delay_s
        self._delay_sigma_s = math.inf if config.delay_s is None else 0.0
        self._delay_tried_at = 0
        self._R_w_m: FloatArray | None = None
        self._fit: Evidence | None = None
        self._shortfall_m_s = 0.5 * config.velocity_step_m_s if config.velocity_rounding == "truncate" else 0.0
        self._telemetry_opinion: LogScale | None = None
        self._sources: dict[str, tuple[float, float]] = {}
        """Scale and sigma of velocity and height on their own, for the report."""
        self._fitted_s = -math.inf
        self._trust = Trust()
        self._looked_wide_at = 0
        self._counts: Counter[str] = Counter()

    # --- input ---------------------------------------------------------------------------------------------------

    def add_telemetry(self, samples: Sequence[TelemetrySample]) -> None:
        """State messages in the order of arrival."""
        for sample in self._track.add(samples):
            self._ekf.add_telemetry(sample)

    def add_visual(
        self, stamp_s: float, T_w_c: FloatArray, sigma_t: float, sigma_r_rad: float, tracked: bool = True
    ) -> None:
        """Pose of one frame in the map.

        Args:
            stamp_s: Stamp of the frame.
            T_w_c: Camera to map ``(4, 4)`` [map units].
            sigma_t: Standard deviation of its translation per axis [map units].
            sigma_r_rad: Standard deviation of its rotation per axis.
            tracked: False when the pose does not rest on this frame's image (predicted, lost): it is then no evidence.
        """
        if not tracked or not np.isfinite(T_w_c).all():
            self._start = None
            self._previous = None
            self._counts["visual not tracked"] += 1
            return
        if self._last is not None and stamp_s <= self._last.stamp_s:
            self._counts["visual out of order"] += 1
            return
        visual = _Visual(stamp_s, np.array(T_w_c, dtype=np.float64), sigma_t, sigma_r_rad)
        gap = self._last is None or stamp_s - self._last.stamp_s > self.config.max_gap_s
        if gap:
            self._start = None
        self._previous = None if gap else self._last
        self._last = visual
        if not self._sightings or stamp_s - self._sightings[-1].stamp_s > 0.09:
            self._sightings.append(visual)
        self._extend_interval(visual)
        self._feed_filter(visual)

    def _extend_interval(self, visual: _Visual) -> None:
        start = self._start
        if start is None:
            self._start = visual
        elif visual.stamp_s - start.stamp_s >= self.config.interval_s - 1e-3:
            sigma = math.hypot(start.sigma_t, visual.sigma_t)
            self._intervals.append(_Interval(start.stamp_s, visual.stamp_s, start.T, visual.T, sigma))
            self._start = visual

    def revise(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        """Later knowledge of earlier poses: a map that was refined has moved them, and its scale has drifted less.

        Args:
            stamps_s: Stamps of frames ``(F,)``, as given to `add_visual`; others are left alone.
            T_w_c: Their poses ``(F, 4, 4)`` in the map as it is now.
        """
        known = dict(zip(stamps_s.tolist(), T_w_c, strict=True))
        for visual in self._remembered():
            visual.T = known.get(visual.stamp_s, visual.T)
        for interval in self._intervals:
            interval.T_from = known.get(interval.from_s, interval.T_from)
            interval.T_to = known.get(interval.to_s, interval.T_to)
        self._fitted_s = -math.inf

    def _remembered(self) -> list[_Visual]:
        """Each remembered pose once."""
        held = (*self._sightings, self._start, self._previous, self._last, self._fed)
        return list({id(visual): visual for visual in held if visual is not None}.values())

    def add_depth_ratio(self, log_ratio: float, sigma_log: float) -> None:
        """One keyframe's log of (network depth [m] / map depth) on its anchors."""
        self._depth.add(log_ratio, sigma_log)

    def rescale(self, factor: float, about: FloatArray | None = None) -> None:
        """The map was scaled: ``p' = about + factor (p - about)``; everything remembered follows."""
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"factor must be positive, got {factor}")
        centre = np.zeros(3) if about is None else np.asarray(about, dtype=np.float64)
        for visual in self._remembered():
            visual.T = _scaled(visual.T, factor, centre)
            visual.sigma_t *= factor
        for interval in self._intervals:
            interval.T_from = _scaled(interval.T_from, factor, centre)
            interval.T_to = _scaled(interval.T_to, factor, centre)
            interval.sigma *= factor
        self._depth.rescale(factor)
        shift = math.log(factor)
        if (held := self._telemetry_opinion) is not None:
            self._telemetry_opinion = LogScale(held.log_scale - shift, held.sigma, held.source)
        self._sources = {name: (s / factor, sigma / factor) for name, (s, sigma) in self._sources.items()}

    def reset_map(self) -> None:
        """A new map in a new gauge: visual memory and scale are forgotten, telemetry and delay are kept."""
        self._intervals.clear()
        self._sightings.clear()
        self._start = self._previous = self._last = self._fed = None
        self._depth = self._new_depth_ratio()
        self._telemetry_opinion, self._sources = None, {}
        self._R_w_m, self._fit, self._fitted_s, self._ekf_delay = None, None, -math.inf, None

    # --- output --------------------------------------------------------------------------------------------------

    @property
    def delay_s(self) -> float:
        """Video delay behind telemetry [s]: configured, estimated, or the guess while nothing is known."""
        return self._delay_s

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of `delay_s`; infinite while it is a guess, 0 when configured."""
        return self._delay_sigma_s

    def scale(self) -> ScaleEstimate:
        """Metres per map unit with sigma and source; held while the motion says nothing new."""
        self._refit()
        opinions = []
        if (told := self._telemetry_opinion) is not None:
            opinions.append(replace(told, sigma=math.hypot(told.sigma, _FOCAL_SHARE * self._focal_sigma)))
        depth = self._depth.estimate()
        if depth is not None:
            opinions.append(depth)
        return fuse(opinions)

    def _new_depth_ratio(self) -> DepthRatio:
        """Map depth, and the network's metres, go with the focal length: its whole uncertainty is the ratio's too."""
        return DepthRatio(math.hypot(self.config.depth_bias_log, self._focal_sigma))

    def gravity(self) -> FloatArray | None:
        """Unit vector ``(3,)`` that points up, in the map frame; ``None`` without telemetry attitude."""
        R = self.rotation()
        return None if R is None else R.T @ np.array([0.0, 0.0, 1.0])

    def rotation(self) -> FloatArray | None:
        """``R_w_m`` ``(3, 3)``: map axes to the drone's power-on world; ``None`` without telemetry attitude."""
        self._refit()
        return self._R_w_m

    def filter_state(self, stamp_s: float | None = None) -> EkfState | None:
        """The Kalman filter's body pose in the power-on world, on the telemetry clock."""
        stamp = self._ekf.stamp_s if stamp_s is None else stamp_s
        return None if stamp is None else self._ekf.state_at(stamp)

    def predict(self, stamp_s: float) -> PoseEstimate | None:
        """Camera pose at a frame's stamp from the last visual pose, visual velocity and telemetry.

        Returns:
            The estimate in map units, or ``None`` before the first tracked frame.
        """
        last = self._last
        if last is None:
            return None
        gap = stamp_s - last.stamp_s
        visual = self._predict_visual(last, gap)
        share = float(np.clip((gap - _VISUAL_REACH_S) / _VISUAL_REACH_S, 0.0, 1.0))
        if self._previous is None:
            share = 1.0
        telemetry = self._predict_telemetry(last, stamp_s) if share > 0.0 and gap > 0.0 else None
        if telemetry is None:
            return visual
        if share >= 1.0:
            return telemetry
        T = se3.exp(share * se3.log(telemetry.T_w_c @ se3.inverse(visual.T_w_c))) @ visual.T_w_c
        sigma_t = (1 - share) * visual.sigma_t + share * telemetry.sigma_t
        sigma_r = (1 - share) * visual.sigma_r_rad + share * telemetry.sigma_r_rad
        return PoseEstimate(stamp_s, T, sigma_t, sigma_r, "visual+telemetry")

    def _predict_visual(self, last: _Visual, gap: float) -> PoseEstimate:
        T = last.T.copy()
        speed = turn = 0.0
        if self._previous is not None:
            dt = last.stamp_s - self._previous.stamp_s
            reach = min(gap, _VISUAL_LIMIT_S) / dt
            v = (last.T[:3, 3] - self._previous.T[:3, 3]) * reach
            increment = rotation_vector(self._previous.T[:3, :3].T @ last.T[:3, :3]) * reach
            T[:3, 3] += v
            T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), increment]))[:3, :3]
            speed, turn = float(np.linalg.norm(v)), float(np.linalg.norm(increment))
        growth = max(0.0, gap) / _VISUAL_REACH_S
        sigma_t = last.sigma_t + growth * max(speed, last.sigma_t)
        return PoseEstimate(last.stamp_s + gap, T, sigma_t, last.sigma_r_rad + growth * max(turn, 0.005), "visual")

    def _predict_telemetry(self, last: _Visual, stamp_s: float) -> PoseEstimate | None:
        if len(self._track) < 2 or not self._trust.motion:
            return None
        times = np.array([last.stamp_s, stamp_s]) - self._delay_s
        # Telemetry runs ahead of a late video; one packet of extrapolation is allowed.
        if times[1] > self._track.last_s + 0.15 or not self._track.covered(times[:1], times[1:] - 0.3)[0]:
            return None
        estimate = self.scale()
        R_w_b = self._track.attitude(times)
        R_c_b = self.T_b_c[:3, :3].T
        T = last.T.copy()
        T[:3, :3] = last.T[:3, :3] @ R_c_b @ R_w_b[0].T @ R_w_b[1] @ R_c_b.T
        gap = float(times[1] - times[0])
        if self._R_w_m is None or not math.isfinite(estimate.sigma):
            return PoseEstimate(stamp_s, T, math.inf, 0.01 + 0.01 * gap, "telemetry")
        moved = np.diff(self._track.displacement(times, self._shortfall_m_s), axis=0)[0]
        if self._fit is not None:
            moved = moved - self._fit.bias * gap
        moved = moved + (R_w_b[1] - R_w_b[0]) @ self.T_b_c[:3, 3]
        T[:3, 3] = last.T[:3, 3] + self._R_w_m.T @ moved / estimate.value
        walk = self.config.sigma_velocity_m_s * math.sqrt(0.1 * gap) + 0.02 * gap
        sigma_m = math.hypot(walk, float(np.linalg.norm(moved)) * estimate.sigma / estimate.value)
        return PoseEstimate(
            stamp_s, T, last.sigma_t + sigma_m / estimate.value, math.radians(0.5) + 0.002 * gap, "telemetry"
        )

    def mount(self) -> Mount | None:
        """How the camera sits on the body, estimated from the flight; ``None`` without enough motion."""
        if len(self._intervals) == 0 or len(self._track) < 2 or not self._trust.velocity:
            return None
        from_s, to_s, moved, sigma = self._visual_displacements()
        use = self._track.covered(from_s - self._delay_s, to_s - self._delay_s)
        if not use.any():
            return None
        from_s, to_s = from_s[use] - self._delay_s, to_s[use] - self._delay_s
        told = self._track.displacement(to_s, self._shortfall_m_s)
        told -= self._track.displacement(from_s, self._shortfall_m_s)
        R_m_c = np.array([i.T_from[:3, :3] for i in self._intervals])[use]
        return estimate_mount(
            np.einsum("nji,nj->ni", R_m_c, moved[use]),
            np.einsum("nji,nj->ni", self._track.attitude(from_s), told),
            to_s - from_s,
            sigma[use],
            self.config.sigma_velocity_m_s,
            self.T_b_c[:3, :3],
        )

    def statistics(self) -> dict[str, float]:
        """Counters and the state of the estimates, for the report."""
        numbers: dict[str, float] = dict(self._counts)
        numbers.update({f"ekf {k}": v for k, v in self._ekf.statistics().items()})
        numbers["telemetry samples"] = len(self._track)
        numbers["telemetry refused"] = self._track.refused
        numbers["displacements"] = len(self._intervals)
        numbers["video delay s"] = self._delay_s
        numbers["video delay sigma s"] = self._delay_sigma_s
        if self._fit is not None:
            numbers["displacement residual m"] = self._fit.rms_m
        numbers.update({f"agreement {reading}": found.share for reading, found in self._trust.latest.items()})
        mount = self.mount()
        if mount is not None:
            numbers["camera tilt deg"] = math.degrees(mount.tilt_rad)
            numbers["camera tilt sigma deg"] = math.degrees(mount.tilt_sigma_rad)
        for name, (value, sigma) in self._sources.items():
            numbers[f"scale {name}"], numbers[f"scale {name} sigma"] = value, sigma
        depth = self._depth.estimate()
        if depth is not None:
            numbers["scale depth"] = math.exp(depth.log_scale)
            numbers["scale depth sigma"] = math.exp(depth.log_scale) * depth.sigma
        return numbers

    # --- estimation ----------------------------------------------------------------------------------------------

    def _refit(self) -> None:
        """Alignment, delay and scale from what is remembered, at most once per second of frames."""
        last = self._last
        if last is None or len(self._track) == 0:
            return
        # Each fit costs more and changes less than the one before.
        pause_s = max(_REFIT_S, _REFIT_SHARE * min(last.stamp_s - self._sightings[0].stamp_s, self.config.window_s))
        if self._R_w_m is not None and last.stamp_s - self._fitted_s < pause_s:
            return
        if self.refined_poses is not None:
            self.revise(*self.refined_poses(last.stamp_s - self.config.window_s))
        self._fitted_s = last.stamp_s
        if self._R_w_m is None:
            self._R_w_m = self._attitude_alignment(self._delay_s)
        if self.config.delay_s is None:
            self._estimate_delay()
        R = self._attitude_alignment(self._delay_s)
        if R is None:
            return
        self._R_w_m = R
        self._judge(R)
        self._trust.at_odds = None
        opinion = self._opinion(R)
        if opinion is not None and opinion.sigma < 0.3:
            self._telemetry_opinion = opinion
        elif not self._still_trusted():
            self._telemetry_opinion, self._sources, self._fit = None, {}, None
        # else nothing new to say: hover, pure rotation, or telemetry missing

    # --- plausibility --------------------------------------------------------------------------------------------

    def warnings(self) -> list[str]:
        """What telemetry tells that the images do not bear out, in sentences; such readings are not used."""
        told, depth = self._telemetry_opinion, self._depth.estimate()
        said = self._trust.warnings() + self._track.warnings()
        if told is not None and depth is not None and _at_odds(told, depth):
            said.append(
                f"telemetry and the depth network contradict each other: {math.exp(told.log_scale):.3g} and "
                f"{math.exp(depth.log_scale):.3g} metres per map unit"
            )
        return said

    def _still_trusted(self) -> bool:
        """Whether all that the held opinion rests on may still tell the scale."""
        heights = [Reading(name) for name in _HEIGHT_SOURCES]
        trusted = {"telemetry": self._trust.velocity, "height": any(map(self._trust.height, heights))}
        return self._trust.at_odds is None and all(trusted[source] for source in self._sources)

    def _judge(self, R_w_m: FloatArray) -> None:
        """Compare velocities and attitude with the images, at the delay in use and, if that fits badly, at others."""
        used = self._compared(self._delay_s, R_w_m)
        for reading, found in used.items():
            self._trust.judge(reading, found)
        now, n = used[Reading.VELOCITY], len(self._intervals)
        if now.correlation >= _FITS_WELL:
            self._trust.elsewhere_s = None
        elif now.count >= _MIN_DELAY_INTERVALS and n >= 1.3 * self._looked_wide_at:
            self._looked_wide_at = n
            self._trust.elsewhere_s = self._fits_elsewhere(now)

    def _fits_elsewhere(self, now: Agreement) -> float | None:
        """The delay at which telemetry surely fits better than now, if that is one which is not allowed."""
        fixed = self.config.delay_s
        low, high = self.config.delay_range_s if fixed is None else (fixed - 0.15, fixed + 0.15)
        best, best_s = now, self._delay_s
        for delay_s in np.arange(_WIDE_DELAYS_S[0], _WIDE_DELAYS_S[1] + 1e-9, _WIDE_STEP_S).tolist():
            R = self._attitude_alignment(delay_s)
            found = None if R is None else self._compared(delay_s, R)[Reading.VELOCITY]
            if found is not None and found.count >= now.count // 2 and found.correlation > best.correlation:
                best, best_s = found, delay_s
        left, left_now = (1.0 - max(a.correlation, 0.0) ** 2 for a in (best, now))
        likelier = 0.25 * now.count * math.log(left_now / max(left, 1e-6))
        sure = best.verdict is Verdict.AGREES and likelier > _MUCH_LIKELIER
        return best_s if sure and not low <= best_s <= high else None

    def _compared(self, delay_s: float, R_w_m: FloatArray) -> dict[Reading, Agreement]:
        """How velocities and attitude go with the images under one delay.

        Without the camera's lever: where velocities say nothing, turns must not speak for them.
        """
        from_s, to_s, moved, _ = self._visual_displacements()
        use = self._track.covered(from_s - delay_s, to_s - delay_s)
        if not use.any():
            return {Reading.VELOCITY: Agreement()}
        duration = (to_s - from_s)[use, None]
        from_s, to_s = from_s[use] - delay_s, to_s[use] - delay_s
        told = self._track.displacement(to_s) - self._track.displacement(from_s)
        slow = self.config.min_speed_m_s
        rough = self._rough_scale()
        least_seen = math.inf if rough is None else 2.0 * slow / rough
        found = {Reading.VELOCITY: agreement(moved[use] @ R_w_m.T / duration, told / duration, least_seen, slow)}
        if self._track.has_attitude:
            seen, told = (Rotation.from_matrix(R).as_rotvec() / duration for R in self._turns(from_s, to_s, use))
            found[Reading.ATTITUDE] = agreement(seen, told, _LEAST_TURN_RAD_S, 1.5 * _LEAST_TURN_RAD_S)
        return found

    def _turns(self, from_s: FloatArray, to_s: FloatArray, use: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations ``(N, 3, 3)`` in body axes over intervals on telemetry's clock, by the images and by telemetry."""
        R_from = np.array([i.T_from[:3, :3] for i in self._intervals])[use]
        R_to = np.array([i.T_to[:3, :3] for i in self._intervals])[use]
        R_b_c = self.T_b_c[:3, :3]
        seen = R_b_c @ np.swapaxes(R_from, 1, 2) @ R_to @ R_b_c.T
        told = np.swapaxes(self._track.attitude(from_s), 1, 2) @ self._track.attitude(to_s)
        return seen, told

    def _rough_scale(self) -> float | None:
        """Metres per map unit, for what counts as motion."""
        depth = self._depth.estimate()
        return math.exp(depth.log_scale) if depth is not None else self._held_scale()

    def _opinion(self, R_w_m: FloatArray) -> LogScale | None:
        """Scale from displacements and height, for readings rounded to the nearest step or truncated.

        The mean of both, weighted by how probable each is; its sigma spans them while that is open. Readings that would
        put velocity and height at odds are so much the less probable.
        """
        config = self.config
        half = 0.5 * config.velocity_step_m_s
        share = {"nearest": 0.0, "truncate": 1.0}.get(config.velocity_rounding)
        if share is None:
            share = self._track.truncation_probability(config.velocity_step_m_s)
        mixed = []  # (probability, opinion)
        for probability, q, systematic in (
            (1.0 - share, 0.0, config.systematic_log),
            (share, half, config.truncation_systematic_log),
        ):
            if probability < _IMPROBABLE:
                continue
            found = self._joint_opinion(R_w_m, q, systematic)
            if found is not None:
                mixed.append((probability * math.exp(-0.5 * min(found.gap, 6.0) ** 2), found))
        if not mixed:
            return None
        best = max(mixed, key=lambda m: m[0])[1]
        self._fit, self._sources, self._shortfall_m_s = best.moved, best.sources, best.shortfall_m_s
        total = sum(p for p, _ in mixed)
        mean = sum(p * o.log_scale for p, o in mixed) / total
        variance = sum(p * (o.sigma**2 + (o.log_scale - mean) ** 2) for p, o in mixed) / total
        return LogScale(mean, math.sqrt(variance), "+".join(best.sources))

    def _joint_opinion(self, R_w_m: FloatArray, shortfall_m_s: float, systematic: float) -> _Opinion | None:
        tilt = self.config.alignment_sigma_rad
        moved = None
        if self._trust.velocity:
            moved = self._displacement_evidence(self._delay_s, R_w_m, shortfall_m_s)
        alone = solved([moved], tilt) if moved is not None else None
        rough = alone[0] if alone is not None else self._rough_scale()
        if rough is None:
            return None
        height = self._height_evidence(R_w_m, rough)
        given = []  # (name, evidence, scale, relative sigma)
        for name, evidence, error in (
            ("telemetry", moved, systematic),
            ("height", height, self.config.height_systematic_log),
        ):
            if evidence is None:
                continue
            evidence = evidence.softened(error * rough)
            single = solved([evidence], tilt)
            if single is not None and single[1] < 0.5:
                given.append((name, evidence, *single))
        together = solved([g[1] for g in given], tilt) if given else None
        if together is None:
            return None
        gap = 0.0
        if len(given) == 2:
            one, other = (LogScale(math.log(s), sigma, name) for name, _, s, sigma in given)
            gap = abs(one.log_scale - other.log_scale) / math.hypot(one.sigma, other.sigma)
            if _at_odds(one, other):
                self._trust.at_odds = given[0][2], given[1][2]
                return None
        sources = {name: (s, s * sigma) for name, _, s, sigma in given}
        # Birge ratio: sources that disagree beyond their sigmas widen the result.
        sigma = max(1.0, gap) * together[1]
        return _Opinion(math.log(together[0]), sigma, gap, moved, sources, shortfall_m_s)

    def _held_scale(self) -> float | None:
        return None if self._telemetry_opinion is None else math.exp(self._telemetry_opinion.log_scale)

    def _attitude_alignment(self, delay_s: float) -> FloatArray | None:
        """Mean of ``R_w_b(telemetry) R_b_c R_m_c^T`` over the remembered poses."""
        if not np.isfinite(self._track.attitude(np.array([0.0]))).all():
            return None
        stamps = np.array([v.stamp_s for v in self._sightings]) - delay_s
        inside = self._track.covered(stamps, stamps)
        if not inside.any():
            return None
        R_m_c = np.array([v.T[:3, :3] for v in self._sightings])[inside]
        R_w_b = self._track.attitude(stamps[inside])
        return mean_rotation(R_w_b @ self.T_b_c[:3, :3] @ np.swapaxes(R_m_c, 1, 2))

    def _displacement_evidence(self, delay_s: float, R_w_m: FloatArray, shortfall_m_s: float) -> Evidence | None:
        if len(self._intervals) == 0:
            return None
        from_s, to_s, *_ = self._visual_displacements()
        use = self._track.covered(from_s - delay_s, to_s - delay_s)
        if use.sum() < 2:
            return None
        from_s, to_s, moved, sigma = self._joined(use)
        from_s, to_s = from_s - delay_s, to_s - delay_s
        lever = self.T_b_c[:3, 3]
        R_from, R_to = self._track.attitude(from_s), self._track.attitude(to_s)
        told = self._track.displacement(np.concatenate([from_s, to_s]), shortfall_m_s)
        moved_m = told[len(from_s) :] - told[: len(from_s)] + (R_to - R_from) @ lever
        moving = self._moving(moved, to_s - from_s, moved_m)
        if moving.sum() < 2:
            return None
        duration = (to_s - from_s)[moving]
        return displacement_evidence(
            moved[moving] @ R_w_m.T,
            moved_m[moving],
            from_s[moving],
            duration,
            sigma[moving],
            self.config.sigma_velocity_m_s * np.sqrt(0.1 * duration),
            self.config.alignment_sigma_rad,
        )

    def _moving(self, moved_map: FloatArray, duration_s: FloatArray, moved_m: FloatArray) -> FloatArray:
        """Intervals fast enough to speak of scale, judged by vision once the scale is roughly known."""
        scale = self._held_scale()
        if scale is not None:
            speed = np.linalg.norm(moved_map, axis=1) * scale / duration_s
        else:
            speed = np.linalg.norm(moved_m, axis=1) / duration_s
        return speed > self.config.min_speed_m_s

    def _visual_displacements(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        from_s = np.array([i.from_s for i in self._intervals])
        to_s = np.array([i.to_s for i in self._intervals])
        moved = np.array([i.T_to[:3, 3] - i.T_from[:3, 3] for i in self._intervals])
        return from_s, to_s, moved, np.array([i.sigma for i in self._intervals])

    def _joined(self, use: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The displacements that may be used, two neighbours made one once there are many.

        Over half a second a map's own errors are a tenth of the way and more, and shrink the scale (23 mm of 118 mm on
        redkitchen: -4 %); over a second they have hardly grown, the way has doubled.
        """
        from_s, to_s, moved, sigma = (x[use] for x in self._visual_displacements())
        if len(from_s) < _MANY_INTERVALS:
            return from_s, to_s, moved, sigma
        touches = np.append(np.abs(from_s[1:] - to_s[:-1]) < 1e-6, False)
        first, k = [], 0
        while k < len(from_s):
            first.append(k)
            k += 2 if touches[k] else 1
        i = np.array(first)
        j = i + touches[i]
        whole = moved[i] + touches[i, None] * moved[j]
        return from_s[i], to_s[j], whole, np.maximum(sigma[i], sigma[j])

    def _height_evidence(self, R_w_m: FloatArray, scale: float) -> Evidence | None:
        """The best of range, SDK height and barometer: they watch the same motion."""
        stamps = np.array([v.stamp_s for v in self._sightings]) - self._delay_s
        poses = np.array([v.T for v in self._sightings])
        lever = -poses[:, :3, :3] @ (self.T_b_c[:3, :3].T @ self.T_b_c[:3, 3])  # from camera to body [m]
        p_w = (poses[:, :3, 3] + lever / scale) @ R_w_m.T
        sigma_map = float(np.median([v.sigma_t for v in self._sightings]))
        best, best_sigma = None, math.inf
        for name, (times, z) in self._track.heights().items():
            if len(times) < 2:
                continue
            # A reading between two sightings, not the other way round: each counts once.
            here = (times >= stamps[0]) & (times <= stamps[-1])
            near = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
            here &= stamps[near] - stamps[near - 1] < self.config.max_gap_s
            if here.sum() < 2:
                continue
            p = np.stack([np.interp(times[here], stamps, p_w[:, k]) for k in range(3)], axis=1)
            sigma = getattr(self.config, _HEIGHT_SOURCES[name])
            segment = floor_segments(times[here], z[here], scale * p[:, 2], step_m=max(0.08, 4.0 * sigma))
            self._judge_height(Reading(name), p[:, 2:], z[here, None], times[here], segment, scale)
            if not self._trust.height(Reading(name)):
                continue
            tilt = self.config.alignment_sigma_rad
            evidence = height_evidence(p, z[here], times[here], segment, sigma_map, sigma, scale, tilt)
            single = solved([evidence], tilt) if evidence is not None else None
            if single is not None and single[1] < best_sigma:
                best, best_sigma = evidence, single[1]
            if best_sigma < _GOOD_HEIGHT:
                break
        return best

    def _judge_height(
        self,
        reading: Reading,
        z_map: FloatArray,
        z_m: FloatArray,
        stamps_s: FloatArray,
        segment: IntArray,
        scale: float,
    ) -> None:
        """Compare changes of one height over a second with the images'; a height that only jumps has no excuse."""
        if segment[-1] > _MOST_STEPS * len(segment):
            segment = np.zeros_like(segment)
        least = max(_LEAST_CLIMB_M, _LEAST_CLIMB_SIGMAS * getattr(self.config, _HEIGHT_SOURCES[reading]))
        seen, told = (changes(z, stamps_s, segment, _HEIGHT_BIN_S) for z in (z_map, z_m))
        self._trust.judge(reading, agreement(seen, told, least / scale, least))

    def _estimate_delay(self) -> None:
        """Delay at which visual and telemetry displacements and turns agree best; refined as evidence grows."""
        n = len(self._intervals)
        if n < _MIN_DELAY_INTERVALS or n < 1.3 * self._delay_tried_at:
            return
        self._delay_tried_at = n
        low, high = self.config.delay_range_s
        from_s, to_s, *_ = self._visual_displacements()
        common = self._track.covered(from_s - high, to_s - low)
        if common.sum() < _MIN_DELAY_INTERVALS:
            return
        delays = np.arange(low, high + 1e-9, _DELAY_STEP_S)
        cost = np.array([self._delay_cost(d, common) for d in delays])
        best = int(np.argmin(cost))
        if not math.isfinite(cost[best]) or best in (0, len(delays) - 1):
            return
        around = cost[best - 1 : best + 2]
        curvature = float(around[0] - 2.0 * around[1] + around[2]) / _DELAY_STEP_S**2
        if curvature <= 0:
            return
        offset = 0.5 * float(around[0] - around[2]) / (curvature * _DELAY_STEP_S**2)
        sigma = math.sqrt(1.0 / curvature)
        far = np.abs(delays - delays[best]) > 0.15
        if sigma > 0.05 or float(np.min(cost[far])) - cost[best] < 6.0:  # a second valley as good as this one
            return
        self._delay_s = float(np.clip(delays[best] + offset * _DELAY_STEP_S, low, high))
        self._delay_sigma_s = math.hypot(sigma, 0.005)

    def _delay_cost(self, delay_s: float, only: FloatArray) -> float:
        """Misfit of displacements (log-likelihood with the residual's own spread) and of rotations."""
        R = self._attitude_alignment(delay_s)
        if R is None:
            return math.inf
        from_s, to_s, moved, _ = self._visual_displacements()
        from_s, to_s, moved = from_s[only] - delay_s, to_s[only] - delay_s, moved[only] @ R.T
        moved_m = self._track.displacement(to_s) - self._track.displacement(from_s)
        centred = moved_m - moved_m.mean(axis=0), moved - moved.mean(axis=0)
        scale = float(np.sum(centred[0] * centred[1]) / max(float(np.sum(centred[1] ** 2)), 1e-30))
        residual = centred[0] - max(scale, 0.0) * centred[1]
        power = np.sort(np.sum(residual**2, axis=1))[: max(3, int(0.9 * len(residual)))]
        sigma = self.config.sigma_velocity_m_s * math.sqrt(0.1 * self.config.interval_s)
        cost = 1.5 * len(residual) * math.log(float(power.mean()) / 3.0 + 0.25 * sigma**2)
        return cost + self._turn_cost(from_s, to_s, only)

    def _turn_cost(self, from_s: FloatArray, to_s: FloatArray, only: FloatArray) -> float:
        seen, told = self._turns(from_s, to_s, only)
        trace = np.einsum("nij,nij->n", seen, told)
        angle = np.sort(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))[: max(3, int(0.9 * len(trace)))]
        floor = (0.5 * self.config.sigma_attitude_rad) ** 2
        return 1.5 * len(trace) * math.log(float(np.mean(angle**2)) / 3.0 + floor)

    def _feed_filter(self, visual: _Visual) -> None:
        """Visual increments to the Kalman filter once they are metric."""
        previous = self._fed
        if self._previous is None or previous is None or not math.isfinite(self._delay_sigma_s):
            self._fed = visual
            return
        if visual.stamp_s - previous.stamp_s < _FEED_S:
            return
        self._fed = visual
        estimate = self.scale()
        if not estimate.sigma < 0.1 * estimate.value or self._telemetry_opinion is None:
            return
        if self._ekf_delay is None or abs(self._ekf_delay - self._delay_s) > 0.1:
            self._ekf_delay = self._delay_s
        T_c = se3.inverse(previous.T) @ visual.T
        moved = float(np.linalg.norm(T_c[:3, 3])) * estimate.value
        T_c[:3, 3] *= estimate.value
        T_b = self.T_b_c @ T_c @ se3.inverse(self.T_b_c)
        sigma_t = math.sqrt(2.0) * visual.sigma_t * estimate.value
        sigma_t = math.hypot(max(sigma_t, 1e-4), moved * estimate.sigma / estimate.value)
        sigma_r = max(math.sqrt(2.0) * visual.sigma_r_rad, 1e-4)
        delay = self._ekf_delay
        self._ekf.add_relative(previous.stamp_s - delay, visual.stamp_s - delay, T_b, sigma_t, sigma_r)


def _at_odds(a: LogScale, b: LogScale) -> bool:
    """Whether one of two opinions must be nonsense, not merely off by more than it says."""
    apart = abs(a.log_scale - b.log_scale)
    return apart > max(_AT_ODDS_LOG, _AT_ODDS * math.hypot(a.sigma, b.sigma))


def _scaled(T: FloatArray, factor: float, centre: FloatArray) -> FloatArray:
    out = T.copy()
    out[:3, 3] = centre + factor * (T[:3, 3] - centre)
    return out
