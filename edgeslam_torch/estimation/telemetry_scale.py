"""Metric scale from the drone's velocities and heights, each alone and combined."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.scale.camera_mount import Turned
from edgeslam_torch.estimation.scale.consensus import CONTRADICTION, at_odds, contradict, sided_with
from edgeslam_torch.estimation.scale.joint_scale import (
    MIN_DISPLACEMENTS,
    Evidence,
    aged_since,
    displacement_evidence,
    height_evidence,
    solved,
    turned_since,
)
from edgeslam_torch.estimation.scale.log_scale import LogScale
from edgeslam_torch.estimation.sensors.height import floor_segments
from edgeslam_torch.estimation.sensors.velocity import (
    Rounding,
    SeenVelocity,
    remainder_gain,
    seen_velocity,
)
from edgeslam_torch.estimation.telemetry.comparison import FlightSoFar
from edgeslam_torch.estimation.telemetry.sensor_validation import (
    AtOdds,
    Reading,
    SensorGate,
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
_MOST_SIGMA = 0.5
"""Relative sigma above which a single source is discarded."""
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
class SourceScale:
    """Scale from one source alone."""

    value: float
    """Metres per map unit."""
    sigma: float


@dataclass(frozen=True, slots=True)
class TelemetryFit:
    """Result of the newest fit, for prediction and for the report."""

    moved: Evidence | None = None
    """From displacements."""
    sources: dict[str, SourceScale] = field(default_factory=dict)
    """Velocities (``telemetry``) and ``height``, each alone."""
    shortfall_m_s: float = 0.0
    """Expected truncation loss of every non-zero velocity reading."""
    truncates: float = 0.5
    """Probability that velocities are truncated, not rounded."""


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Scale under one rounding mode of the velocities."""

    log_scale: float
    sigma: float
    log_odds: float
    """Log-likelihood of the displacements up to a constant, with a penalty on the gap between velocity and height."""
    fit: TelemetryFit
    at_odds: AtOdds | None


@dataclass(frozen=True, slots=True)
class _Given:
    """One kind of evidence with the scale that it gives alone."""

    name: str
    evidence: Evidence
    scale: float
    sigma: float
    """Relative."""

    @property
    def opinion(self) -> LogScale:
        """The estimate in the log domain."""
        return LogScale(math.log(self.scale), self.sigma, self.name)


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
        config: Settings.
        T_b_c: Camera in the body ``(4, 4)`` [m].
        present: Visual poses and telemetry so far.
        trust: Which readings are usable.
        delay_s: Video delay behind telemetry.
        turned: Rotation of the map relative to the power-on world.
        held: Previous scale [metres per map unit].
        flying: Estimate the present scale of a drifting map; otherwise one scale for the whole map.
    """

    def __init__(
        self,
        config: FusionConfig,
        T_b_c: FloatArray,
        present: FlightSoFar,
        trust: SensorGate,
        delay_s: float,
        turned: Turned,
        held: float | None,
        flying: bool = False,
    ) -> None:
        self._config, self._T_b_c = config, T_b_c
        self._present, self._trust = present, trust
        self._delay_s, self._held = delay_s, held
        self._R_w_m, self._tilt_rad = turned.R_w_m, turned.sigma_rad
        self._flying = flying
        self._shown = self._compared() if trust.velocity else None

    def opinion(self) -> tuple[LogScale, TelemetryFit] | None:
        """Scale averaged over both rounding modes; ``None`` without a usable source.

        Modes are weighted by their posterior probability: sweeps through zero, likelihood of the displacements, and
        consistency of velocity and height. The sigma covers both modes.
        """
        config = self._config
        fixed = {"nearest": Rounding.NEAREST, "truncate": Rounding.TRUNCATE}.get(config.velocity_rounding)
        sweeps = 0.0 if fixed else self._present.track.truncation_log_odds(config.velocity_step_m_s)
        systematic = {
            Rounding.NEAREST: VELOCITY_SCALE_LOG,
            Rounding.TRUNCATE: VELOCITY_TRUNCATED_SCALE_LOG,
        }
        tried = (Rounding.NEAREST, Rounding.TRUNCATE) if fixed is None else (fixed,)
        moved = {r: self._by_displacements(r) for r in tried}
        compared = all(evidence is not None for evidence in moved.values())
        if not compared:  # the rounding modes compare only if both have displacements
            moved = dict.fromkeys(tried)
        few = self._shown is None or len(self._shown.intervals) < MIN_DISPLACEMENTS
        torn = all(evidence is not None and evidence.torn for evidence in moved.values())
        self._trust.tells_scale = few or (compared and not torn)
        if torn:
            return None
        found = {r: h for r in tried if (h := self._together(r, moved[r], systematic[r])) is not None}
        if not found:
            return None
        log_odds = np.array([h.log_odds + (sweeps if r is Rounding.TRUNCATE else 0.0) for r, h in found.items()])
        share = np.exp(log_odds - log_odds.max())
        share /= share.sum()
        mixed = list(zip(share.tolist(), found.values(), strict=True))
        best = max(mixed, key=lambda m: m[0])[1]
        self._trust.at_odds = best.at_odds
        mean = sum(p * o.log_scale for p, o in mixed)
        variance = sum(p * (o.sigma**2 + (o.log_scale - mean) ** 2) for p, o in mixed)
        truncates = dict(zip(found, share.tolist(), strict=True)).get(Rounding.TRUNCATE, 0.0)
        fit = replace(best.fit, truncates=truncates)
        return LogScale(mean, math.sqrt(variance), "+".join(fit.sources)), fit

    def _together(self, rounding: Rounding, moved: Evidence | None, systematic: float) -> _Hypothesis | None:
        tilt = self._tilt_rad
        rough = self._rough(moved)
        if rough is None:
            return None
        velocity = self._alone("telemetry", moved, systematic, rough)
        # Velocities less accurate than the scale difference between views cannot rule it out.
        vouching = moved if velocity is not None and velocity.sigma < _OF_A_VIEW else None
        given = [g for g in (velocity, self._height_alone(rough, vouching)) if g is not None]
        odds = self._at_odds(*given) if len(given) == 2 else None
        if odds is not None and odds.kept is not None:
            given = [g for g in given if g.name == odds.kept]
            if odds.kept == "height":  # recompute without the drift model of the rejected velocities
                given = [g for g in (self._height_alone(rough, None),) if g is not None]
        together = solved([g.evidence for g in given], tilt) if given else None
        if together is None:
            return None
        gap = parted_log = 0.0
        if len(given) == 2:
            one, other = (g.opinion for g in given)
            gap = abs(one.log_scale - other.log_scale) / math.hypot(one.sigma, other.sigma)
            if contradict(one, other):  # one of the two is wrong: the sigma covers both
                parted_log = abs(one.log_scale - other.log_scale)
        sources = {g.name: SourceScale(g.scale, g.scale * g.sigma) for g in given}
        # Birge ratio: disagreement beyond the sigmas widens the result.
        sigma = max(parted_log, max(1.0, gap) * together[1])
        log_odds = (0.0 if moved is None else moved.log_likelihood) - 0.5 * min(gap, CONTRADICTION) ** 2
        moved = moved if "telemetry" in sources else None
        shortfall_m_s = 0.5 * self._config.velocity_step_m_s if rounding is Rounding.TRUNCATE else 0.0
        fit = TelemetryFit(moved, sources, shortfall_m_s)
        return _Hypothesis(math.log(together[0]), sigma, log_odds, fit, odds)

    def _alone(self, name: str, evidence: Evidence | None, systematic: float, rough: float) -> _Given | None:
        """Scale from one kind of evidence, with its systematic error."""
        if evidence is None:
            return None
        evidence = evidence.softened(systematic * rough)
        single = solved([evidence], self._tilt_rad)
        return None if single is None or single[1] >= _MOST_SIGMA else _Given(name, evidence, *single)

    def _height_alone(self, rough: float, moved: Evidence | None) -> _Given | None:
        return self._alone("height", self._by_height(rough, moved), HEIGHT_SCALE_LOG, rough)

    def _at_odds(self, velocity: _Given, height: _Given) -> AtOdds | None:
        """Contradictory scales from velocities and heights, and which of them the depth network supports."""
        one, other = velocity.opinion, height.opinion
        if not at_odds(one, other):
            return None
        kept = sided_with(one, other, self._present.network)
        return AtOdds(velocity.scale, height.scale, None if kept is None else kept.source)

    def _rough(self, moved: Evidence | None) -> float | None:
        """Rough scale for detecting floor steps: from velocities, unless the network contradicts them."""
        network = self._present.network
        alone = None if moved is None else solved([moved], self._tilt_rad)
        if alone is None:
            known = self._present.rough_scale
            return self._shown.start if known is None and self._shown is not None else known
        wrong = network is not None and contradict(LogScale(math.log(alone[0]), alone[1], "telemetry"), network)
        return self._present.rough_scale if wrong else alone[0]

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
            evidence = self._evidence(intervals, whole, self._aged(intervals.to_s))
            alone = None if evidence is None else solved([evidence], tilt)
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

    def _evidence(self, moved: Displacements, moved_m: FloatArray, aged: FloatArray | None) -> Evidence | None:
        return displacement_evidence(
            moved.moved @ self._R_w_m.T,
            moved_m,
            moved.from_s,
            moved.duration_s,
            moved.sigma,
            VELOCITY_M_S * np.sqrt(0.1 * moved.duration_s),
            self._tilt_rad,
            aged,
        )

    def _aged(self, stamps_s: FloatArray) -> FloatArray | None:
        """Log age of the map since each time ``(N,)`` of telemetry's clock, see `aged_since`; None if drift is not
        modelled."""
        memory = self._present.memory
        if not self._flying or memory.last is None:
            return None
        return aged_since(stamps_s + self._delay_s, memory.began_s, memory.last.stamp_s)

    def _compared(self) -> _Shown | None:
        """Intervals in which the drone moves."""
        track, config, memory = self._present.track, self._config, self._present.memory
        moved = memory.displacements()
        if len(moved) == 0:
            return None
        use = track.covered(moved.from_s - self._delay_s, moved.to_s - self._delay_s)
        if use.sum() < 2:
            return None
        moved = moved.only(use).joined().on_telemetry_clock(self._delay_s)
        R_from, R_to = track.attitude(moved.from_s), track.attitude(moved.to_s)
        reported = track.displacement(np.concatenate([moved.from_s, moved.to_s]))
        moved_m = reported[len(moved) :] - reported[: len(moved)] + (R_to - R_from) @ self._T_b_c[:3, 3]
        moving = self._moving(moved, moved_m)
        if moving.sum() < 2:
            return None
        moved, moved_m = moved.only(moving), moved_m[moving]
        ways = float(np.sum(moved_m**2)), float(np.sum(moved.moved**2))
        if min(ways) <= 0.0:
            return None
        seen = memory.sightings()
        velocity = seen_velocity(track, seen, self._delay_s, self._R_w_m, self._T_b_c, config.max_gap_s)
        return _Shown(moved, moved_m, velocity, math.sqrt(ways[0] / ways[1]))

    def _moving(self, moved: Displacements, moved_m: FloatArray) -> np.ndarray:
        """Mask of intervals above the minimum speed, measured by vision once the scale is roughly known."""
        if self._held is not None:
            speed = np.linalg.norm(moved.moved, axis=1) * self._held / moved.duration_s
        else:
            speed = np.linalg.norm(moved_m, axis=1) / moved.duration_s
        return speed > self._config.min_speed_m_s

    def _by_height(self, scale: float, moved: Evidence | None) -> Evidence | None:
        """Evidence from the most accurate of range sensor, SDK height and barometer: they observe the same motion."""
        config = self._config
        seen = self._present.memory.sightings()
        stamps_s = seen.stamps_s - self._delay_s
        lever = -seen.T[:, :3, :3] @ (self._T_b_c[:3, :3].T @ self._T_b_c[:3, 3])  # from camera to body [m]
        p_w = (seen.T[:, :3, 3] + lever / scale) @ self._R_w_m.T
        sigma_map = float(np.median(seen.sigma_t))
        best, best_sigma = None, math.inf
        for name, (times, z) in self._present.track.heights().items():
            if len(times) < 2:
                continue
            # Interpolate poses at readings, not readings at poses: each reading counts once.
            here = (times >= stamps_s[0]) & (times <= stamps_s[-1])
            near = np.clip(np.searchsorted(stamps_s, times), 1, len(stamps_s) - 1)
            here &= stamps_s[near] - stamps_s[near - 1] < config.max_gap_s
            if here.sum() < 2:
                continue
            p = np.stack([np.interp(times[here], stamps_s, p_w[:, k]) for k in range(3)], axis=1)
            sigma = HEIGHT_M[name]
            segment = floor_segments(times[here], z[here], scale * p[:, 2], step_m=max(0.08, 4.0 * sigma))
            self._judge_height(Reading(name), p[:, 2:], z[here, None], times[here], segment, scale)
            if not self._trust.height(Reading(name)):
                continue
            if moved is None and self._trust.latest[Reading(name)].count < _LEAST_CHANGES:
                continue
            tilt = self._tilt_rad
            aged, wander = self._aged(times[here]), MAP_WANDER_LOG[0] if moved is None else moved.wander
            if moved is None:  # nothing else tells how far the scale of other views differs
                by_views = np.interp(times[here], stamps_s, turned_since(seen.T)) * (_OF_A_VIEW / wander) ** 2
                aged = by_views if aged is None else aged + by_views
            evidence = height_evidence(p, z[here], times[here], segment, sigma_map, sigma, scale, tilt, aged, wander)
            if evidence is not None:
                evidence = evidence.softened(scale * _by_steps(z[here], HEIGHT_STEP_M[name]))
            single = solved([evidence], tilt) if evidence is not None else None
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
