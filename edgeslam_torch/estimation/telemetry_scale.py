"""Metric scale from the drone's velocities and heights: of the present map, and around one moment of the flight.

A monocular map drifts in scale, so that two places in it may differ; local velocities measure the difference.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.config import MAX_GAP_S, MIN_SPEED_M_S
from edgeslam_torch.estimation.scale.belief import ScaleBelief, contradict
from edgeslam_torch.estimation.scale.camera_mount import Turned
from edgeslam_torch.estimation.scale.evidence import (
    MIN_DISPLACEMENTS,
    Evidence,
    aged_since,
    displacement_evidence,
    height_evidence,
    turned_since,
)
from edgeslam_torch.estimation.sensors.height import floor_segments
from edgeslam_torch.estimation.sensors.velocity import SeenVelocity, remainder_gain, seen_velocity
from edgeslam_torch.estimation.telemetry.alignment import camera_moved, in_common
from edgeslam_torch.estimation.telemetry.quantisation import Rounding
from edgeslam_torch.estimation.telemetry.remembered import Remembered
from edgeslam_torch.estimation.telemetry.sensor_validation import (
    Reading,
    agreement,
    changes,
)
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements
from edgeslam_torch.noise import (
    HEIGHT_M,
    HEIGHT_SCALE_LOG,
    HEIGHT_STEP_M,
    MAP_WANDER_LOG,
    VELOCITY_M_S,
    VELOCITY_SCALE_LOG,
    VELOCITY_TRUNCATED_SCALE_LOG,
)
from edgeslam_torch.types import FloatArray, IntArray

_MOST_ROUNDS = 5
_SETTLED = 0.003
"""Relative change of the scale below which the remainders are not recomputed: a third of `VELOCITY_SCALE_LOG`."""
_MOST_CHANGE = 0.5
_UNDITHERED = 0.05
"""Residual error of the remainders [steps]. With 0.2 to 0.3 steps of noise before rounding, the mean reading is off by
0.15 to 0.05 steps with a sign that varies with speed; averaging over speeds leaves about two thirds."""
_UNPROVEN = 15.0
"""Number of intervals up to which residuals hardly distinguish rounding modes: at similar speeds quantisation errors
repeat, and the map's own errors may look like either."""
_GOOD_HEIGHT = 0.2
"""Relative sigma at which the search stops: the remaining height sources observe the same motion less accurately."""
_HEIGHT_BIN_S = 0.5
_OF_A_VIEW = 0.15
"""Typical change of the depth network's log scale between two views without overlap. The scales of submaps connected by
pure rotation differ by as much: no parallax constrains them."""
_LEAST_CLIMB_M = 0.05
_LEAST_CLIMB_SIGMAS = 2.0
_LEAST_CHANGES = 2
"""Minimum number of such height changes within a second for a scale from heights alone; with fewer, drift of the sensor
or of the map dominates the slope."""
_MOST_STEPS = 0.3
"""Maximum share of height readings classified as floor steps; furniture causes fewer."""


@dataclass(frozen=True, slots=True)
class TelemetryFit:
    """Result of the newest fit of velocities, for prediction and for the report."""

    rms_m: float | None = None
    """RMS residual of the displacements."""
    shortfall_m_s: float = 0.0
    """Expected truncation loss of every non-zero velocity reading."""
    noise_log: float = 0.0
    """Error of the log scale that velocities and heights share, by the map's noise: how much of the noise is the map's
    is hardly known. It matters where the path is hardly longer than the noise."""
    truncates: float = 0.5
    """Probability that velocities are truncated, not rounded."""
    path_ratio: float | None = None
    """Length of the path by velocities over that by vision: metres per map unit, roughly."""


@dataclass(frozen=True, slots=True)
class _Shown:
    """Inputs of the displacement fit."""

    intervals: Displacements
    """On telemetry's clock."""
    reported: FloatArray
    """``(N, 3)`` displacements by the raw readings [m]."""
    velocity: SeenVelocity
    start: float
    """Initial scale: the ratio of path lengths."""

    @property
    def speed(self) -> float:
        """RMS speed [map units/s]."""
        return math.sqrt(
            float(np.mean(np.sum((self.intervals.moved / self.intervals.duration_s[:, None]) ** 2, axis=1)))
        )

    @property
    def ends_s(self) -> FloatArray:
        """Starts and ends ``(2 N,)`` of the intervals."""
        return np.concatenate([self.intervals.from_s, self.intervals.to_s])


def _by_steps(z_m: FloatArray, step_m: float) -> float:
    """Relative scale error due to heights ``(N,)`` quantised to ``step_m``; repetition does not reduce it.

    The same height always has the same quantisation error. Over a uniform climb through ``m`` steps the slope is off by
    ``-1 / m**2`` (from edge to edge) to ``+1 / (2 m**2)`` (from middle to middle).
    """
    return min(1.0, (step_m / max(float(np.ptp(z_m)), 1e-6)) ** 2)


class TelemetryScale:
    """Scale from displacements and heights at one moment; updates the height verdicts of `SensorGate`.

    Args:
        flight: Visual poses and telemetry so far, and which readings are usable.
        T_b_c: Camera in the body ``(4, 4)`` [m].
        turned: Rotation of the map relative to the power-on world.
        rough: Metres per map unit, if roughly known.
        network: Scale by the depth network, which decides between contradictory velocities and heights.
        previous: Previous scale [metres per map unit].
        flying: Estimate the present scale of a drifting map; otherwise one scale for the whole map.
    """

    def __init__(
        self,
        flight: Remembered,
        T_b_c: FloatArray,
        turned: Turned,
        rough: float | None,
        network: ScaleBelief | None,
        previous: float | None,
        flying: bool = False,
    ) -> None:
        self._flight, self._T_b_c = flight, T_b_c
        self._config, self._trust, self._delay_s = flight.config, flight.trust, flight.delay_s
        self._rough, self._network, self._previous = rough, network, previous
        self._R_w_m, self._tilt_rad = turned.R_w_m, turned.sigma_rad
        self._flying = flying
        self._shown = self._compared() if self._trust.velocity else None

    def beliefs(self) -> tuple[dict[str, ScaleBelief] | None, TelemetryFit | None]:
        """Scale by velocities (``telemetry``) and by ``height``, each alone, None in hover, and details of the fit.

        That of velocities is averaged over both rounding modes, weighted by their posterior probability: sweeps through
        zero, and likelihood of the displacements. Its sigma covers both modes.
        """
        config = self._config
        fixed = {"nearest": Rounding.NEAREST, "truncate": Rounding.TRUNCATE}.get(config.velocity_rounding)
        sweeps = 0.0 if fixed else self._flight.track.truncation_log_odds(config.velocity_step_m_s)
        tried = tuple(Rounding) if fixed is None else (fixed,)
        moved = {r: e for r in tried if (e := self._by_displacements(r)) is not None}
        compared = len(moved) == len(tried)  # the rounding modes compare only if both have displacements
        few = self._shown is None or len(self._shown.intervals) < MIN_DISPLACEMENTS
        torn = compared and all(evidence.torn for evidence in moved.values())
        self._trust.tells_scale = few or (compared and not torn)
        if torn:
            return {}, None
        velocity = {r: v for r, e in moved.items() if (v := self._by_velocity(r, e)) is not None} if compared else {}
        noise_log = 0.0
        log_odds = {r: sweeps if r is Rounding.TRUNCATE else 0.0 for r in velocity or tried}
        if velocity:
            best = max(velocity, key=lambda r: moved[r].log_likelihood)
            height = self._height_alone(velocity[best], moved[best])
            noise_log = max(abs(moved[r].noise_log) for r in velocity)
            count = 0 if self._shown is None else len(self._shown.intervals)
            counts = count / (count + _UNPROVEN)
            log_odds = {r: odds + counts * moved[r].log_likelihood for r, odds in log_odds.items()}
        else:
            height = self._height_alone(None, None)
        share = np.exp(np.array(list(log_odds.values())) - max(log_odds.values()))
        weight = dict(zip(log_odds, (share / share.sum()).tolist(), strict=True))
        found = {} if height is None else {"height": height}
        rms = None
        if velocity:
            mean = sum(weight[r] * v.log_scale for r, v in velocity.items())
            variance = sum(weight[r] * (v.sigma**2 + (v.log_scale - mean) ** 2) for r, v in velocity.items())
            found = {"telemetry": ScaleBelief(mean, math.sqrt(variance), "telemetry")} | found
            rms = moved[max(velocity, key=lambda r: weight[r])].rms_m
        truncates = weight.get(Rounding.TRUNCATE, 0.0)
        shortfall_m_s = 0.5 * config.velocity_step_m_s if truncates > 0.5 else 0.0
        path_ratio = None if self._shown is None else self._shown.start
        fit = TelemetryFit(rms, shortfall_m_s, noise_log, truncates, path_ratio) if found else None
        return None if few and not found else found, fit

    def _by_velocity(self, rounding: Rounding, moved: Evidence) -> ScaleBelief | None:
        systematic = VELOCITY_TRUNCATED_SCALE_LOG if rounding is Rounding.TRUNCATE else VELOCITY_SCALE_LOG
        return moved.belief("telemetry", self._tilt_rad, systematic)

    def _height_alone(self, velocity: ScaleBelief | None, moved: Evidence | None) -> ScaleBelief | None:
        """Scale by heights; floor steps are found with the scale by velocities, unless the network contradicts it."""
        network, known = self._network, self._rough
        rough = None if velocity is None else velocity.estimate.value
        if rough is None or (velocity is not None and network is not None and contradict(velocity, network)):
            rough = self._shown.start if known is None and self._shown is not None else known
        if rough is None:
            return None
        # Velocities less accurate than the scale difference between views cannot rule it out.
        vouching = moved if velocity is not None and velocity.sigma < _OF_A_VIEW else None
        evidence = self._by_height(rough, vouching)
        if evidence is None:
            return None
        return evidence.belief("height", self._tilt_rad, math.hypot(HEIGHT_SCALE_LOG, evidence.noise_log))

    def _by_displacements(self, rounding: Rounding) -> Evidence | None:
        """Fit velocities to displacements; the quantisation remainders depend on the scale, so iterate to a fixed
        point."""
        shown = self._shown
        if shown is None:
            return None
        tilt, step = self._tilt_rad, self._config.velocity_step_m_s
        intervals, reported = shown.intervals, shown.reported
        scale = shown.start
        for _ in range(_MOST_ROUNDS):
            lost = shown.velocity.lost(shown.ends_s, scale, step, rounding)
            whole = reported + lost[len(intervals) :] - lost[: len(intervals)]
            evidence = _evidence(intervals, whole, self._R_w_m, tilt, self._aged(intervals.to_s))
            alone = None if evidence is None else evidence.solved(tilt)
            if evidence is None or alone is None:
                return None
            gain = remainder_gain(shown.velocity, intervals, self._R_w_m, scale, step, rounding)
            speed_m_s = alone[0] * shown.speed
            repeated = alone[1] * math.sqrt((1.0 - gain) ** -2 - 1.0)
            softened = evidence.softened(alone[0] * math.hypot(repeated, _UNDITHERED * step / speed_m_s))
            change = (alone[0] / scale - 1.0) / (1.0 - gain)
            if abs(change) < _SETTLED:
                break
            scale *= 1.0 + float(np.clip(change, -_MOST_CHANGE, _MOST_CHANGE))
        return softened

    def _aged(self, stamps_s: FloatArray) -> FloatArray | None:
        """Log age of the map since each time ``(N,)`` of telemetry's clock, see `aged_since`; None if drift is not
        modelled."""
        memory = self._flight.memory
        if not self._flying or memory.last is None:
            return None
        return aged_since(stamps_s + self._delay_s, memory.began_s, memory.last.stamp_s)

    def _compared(self) -> _Shown | None:
        """Intervals in which the drone moves."""
        track, memory = self._flight.track, self._flight.memory
        moved = memory.displacements()
        moved = in_common(moved, track, self._delay_s).joined()
        if len(moved) < 2:
            return None
        moved_m = camera_moved(moved, track, self._T_b_c[:3, 3])
        moving = self._moving(moved, moved_m)
        if moving.sum() < 2:
            return None
        moved, moved_m = moved.only(moving), moved_m[moving]
        ways = float(np.sum(moved_m**2)), float(np.sum(moved.moved**2))
        if min(ways) <= 0.0:
            return None
        seen = memory.sightings()
        velocity = seen_velocity(track, seen, self._delay_s, self._R_w_m, self._T_b_c, MAX_GAP_S)
        return _Shown(moved, moved_m, velocity, math.sqrt(ways[0] / ways[1]))

    def _moving(self, moved: Displacements, moved_m: FloatArray) -> np.ndarray:
        """Mask of intervals above the minimum speed, measured by vision once the scale is roughly known."""
        if self._previous is not None:
            speed = np.linalg.norm(moved.moved, axis=1) * self._previous / moved.duration_s
        else:
            speed = np.linalg.norm(moved_m, axis=1) / moved.duration_s
        return speed > MIN_SPEED_M_S

    def _by_height(self, scale: float, moved: Evidence | None) -> Evidence | None:
        """Evidence from the most accurate of range sensor, SDK height and barometer: they observe the same motion."""
        seen = self._flight.memory.sightings()
        stamps_s = seen.stamps_s - self._delay_s
        lever = -seen.T[:, :3, :3] @ (self._T_b_c[:3, :3].T @ self._T_b_c[:3, 3])  # from camera to body [m]
        p_w = (seen.T[:, :3, 3] + lever / scale) @ self._R_w_m.T
        vertical_c = np.einsum("w,nwc->nc", self._R_w_m[2], seen.T[:, :3, :3])
        sigma_map = float(np.median(seen.sigma_t))
        best, best_sigma = None, math.inf
        for name, (times, z) in self._flight.track.heights().items():
            if len(times) < 2:
                continue
            # Interpolate poses at readings, not readings at poses: each reading counts once.
            here = (times >= stamps_s[0]) & (times <= stamps_s[-1])
            near = np.clip(np.searchsorted(stamps_s, times), 1, len(stamps_s) - 1)
            here &= stamps_s[near] - stamps_s[near - 1] < MAX_GAP_S
            if here.sum() < 2:
                continue
            p, down = (
                np.stack([np.interp(times[here], stamps_s, x[:, k]) for k in range(3)], axis=1)
                for x in (p_w, vertical_c)
            )
            sigma = HEIGHT_M[name]
            segment = floor_segments(times[here], z[here], scale * p[:, 2], step_m=max(0.08, 4.0 * sigma))
            self._judge_height(Reading(name), p[:, 2:], z[here, None], times[here], segment, scale)
            if not self._trust.height(Reading(name)):
                continue
            if moved is None and self._trust.latest[Reading(name)].count < _LEAST_CHANGES:
                continue
            tilt = self._tilt_rad
            aged, wander = self._aged(times[here]), MAP_WANDER_LOG[0] if moved is None else moved.wander
            if moved is None:  # no other estimate of how far the scale of other views differs
                by_views = np.interp(times[here], stamps_s, turned_since(seen.T)) * (_OF_A_VIEW / wander) ** 2
                aged = by_views if aged is None else aged + by_views
            evidence = height_evidence(
                p, down, z[here], times[here], segment, sigma_map, sigma, scale, tilt, aged, wander
            )
            if evidence is not None:
                evidence = evidence.softened(scale * _by_steps(z[here], HEIGHT_STEP_M[name]))
            single = None if evidence is None else evidence.solved(tilt)
            if evidence is not None and single is not None and single[1] < best_sigma:
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
        """Validate one height by its changes over a second; if most changes are steps, they are compared as well."""
        if segment[-1] > _MOST_STEPS * len(segment):
            segment = np.zeros_like(segment)
        least = max(_LEAST_CLIMB_M, _LEAST_CLIMB_SIGMAS * HEIGHT_M[reading])
        seen, reported = (changes(z, stamps_s, segment, _HEIGHT_BIN_S) for z in (z_map, z_m))
        self._trust.judge(reading, agreement(seen, reported, least / scale, least))


def _evidence(
    moved: Displacements,
    moved_m: FloatArray,
    R_w_m: FloatArray,
    tilt_rad: float | FloatArray,
    aged: FloatArray | None = None,
) -> Evidence | None:
    """Evidence from visual displacements and telemetry's ``(N, 3)`` [m], by the noise of its velocities."""
    return displacement_evidence(
        moved.moved @ R_w_m.T,
        moved_m,
        moved.from_s,
        moved.duration_s,
        moved.sigma,
        VELOCITY_M_S * np.sqrt(0.1 * moved.duration_s),
        moved.R_to - moved.R_from,
        tilt_rad,
        aged,
    )
