"""Metric scale from the drone's velocities and heights: what they say of the map, alone and together."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.scale.camera_mount import Turned
from edgeslam_torch.fusion.scale.consensus import CONTRADICTION, at_odds, contradict, sided_with
from edgeslam_torch.fusion.scale.joint_scale import (
    MIN_DISPLACEMENTS,
    MOST_WANDER,
    USUAL_WANDER,
    Evidence,
    aged_since,
    displacement_evidence,
    height_evidence,
    solved,
    turned_since,
)
from edgeslam_torch.fusion.scale.log_scale import LogScale, floor_segments
from edgeslam_torch.fusion.scale.windowed_scale import PRESENT_S, Parted, has_changed, present_scale
from edgeslam_torch.fusion.telemetry.comparison import FlightSoFar
from edgeslam_torch.fusion.telemetry.sensor_validation import (
    LEAST_COUNT,
    AtOdds,
    Reading,
    SensorGate,
    Verdict,
    agreement,
    changes,
)
from edgeslam_torch.fusion.telemetry.velocity_quantisation import (
    Rounding,
    SeenVelocity,
    remainder_gain,
    seen_velocity,
)
from edgeslam_torch.fusion.telemetry.visual_memory import Displacements
from edgeslam_torch.types import FloatArray, IntArray

_MOST_ROUNDS = 5
_SETTLED = 0.003
"""Relative change of the scale below which remainders need not be computed again: a third of `systematic_log`."""
_MOST_CHANGE = 0.5
_UNDITHERED = 0.05
"""Error of all remainders together, in steps: with 0.2 to 0.3 steps of noise before the rounding a reading is off by
0.15 to 0.05 steps in the mean, up or down with the speed, and the speeds of a flight average two thirds of it."""
_MOST_SIGMA = 0.5
"""Relative sigma beyond which a source on its own says nothing."""
_GOOD_HEIGHT = 0.2
"""Relative sigma with which a height source is good enough; the next one would say the same less well."""
_HEIGHT_BIN_S = 0.5
_HEIGHT_SOURCES = {"tof": "sigma_tof_m", "h": "sigma_h_m", "baro": "sigma_baro_m"}
_HEIGHT_STEP_M = {"tof": 0.01, "h": 0.1, "baro": 0.01}
"""Steps in which the SDK tells them."""
_OF_A_VIEW = 0.15
"""By how much the network's metres usually differ between two views that share nothing. So do the units of the parts of
a map whose drone only turns: no parallax holds them together."""
_LEAST_CLIMB_M = 0.05
_LEAST_CLIMB_SIGMAS = 2.0
_LEAST_CHANGES = 2
"""Changes of height beyond that within a second from which on heights alone tell metres: without any, their slope is
that of what drifts, the sensor or the map."""
_LEAST_MOVING, _LEAST_SHARE, _ROUGH_LOG = 4, 0.25, 0.2
"""Moving intervals, and share of the motion that velocities must explain, for a ratio of lengths to mean anything, and
that ratio's error."""
_EXPLAINED = 0.98
"""Correlation of velocities and images, their means left in, below which a fifth of the way (root mean square) is
unexplained: whole steps of 0.1 m/s leave less, and so does a delay that is 0.25 s off."""
_MOST_STEPS = 0.3
"""Share of height readings that may step: more is not furniture passing below."""


@dataclass(frozen=True, slots=True)
class SourceScale:
    """Scale by one source on its own."""

    value: float
    """Metres per map unit."""
    sigma: float


_FADING = 0.1
"""What a map that has changed its scale may change it further until the next fit, seconds later."""


@dataclass(frozen=True, slots=True)
class TelemetryFit:
    """What the newest fit found, for prediction and for the report."""

    moved: Evidence | None = None
    """From displacements."""
    sources: dict[str, SourceScale] = field(default_factory=dict)
    """Velocities (``telemetry``) and ``height`` on their own."""
    shortfall_m_s: float = 0.0
    """How much every velocity that is not zero reads low, as likely as not."""
    truncates: float = 0.5
    """Probability that velocities are truncated, not rounded."""


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Scale under one reading of the velocities: rounded to the nearest step, or truncated."""

    log_scale: float
    sigma: float
    log_odds: float
    """How well it explains the displacements, up to a constant, less what puts velocity and height apart."""
    fit: TelemetryFit
    at_odds: AtOdds | None


@dataclass(frozen=True, slots=True)
class _Given:
    """One kind of evidence with what it says alone."""

    name: str
    evidence: Evidence
    scale: float
    sigma: float
    """Relative."""

    @property
    def opinion(self) -> LogScale:
        """In logarithms."""
        return LogScale(math.log(self.scale), self.sigma, self.name)


@dataclass(frozen=True, slots=True)
class _Shown:
    """What velocities are compared with."""

    intervals: Displacements
    """On telemetry's clock."""
    told: FloatArray
    """``(N, 3)`` their displacements by the readings as they are [m]."""
    velocity: SeenVelocity
    start: float
    """Scale to begin with, from the lengths of both."""

    @property
    def speed(self) -> float:
        """Root mean square [map units/s]."""
        return math.sqrt(
            float(np.mean(np.sum((self.intervals.moved / self.intervals.duration_s[:, None]) ** 2, axis=1)))
        )

    @property
    def ends_s(self) -> FloatArray:
        """Starts and ends ``(2 N,)``."""
        return np.concatenate([self.intervals.from_s, self.intervals.to_s])


def _shared_drift(given: list[_Given]) -> float:
    """Error of a mean of velocities and heights that its sigma lacks: the drift of the map is the same for both."""
    if len(given) < 2:
        return 0.0
    weight = np.array([g.sigma for g in given]) ** -2.0
    one, other = weight / weight.sum() * [g.evidence.drift_sigma for g in given]
    return math.sqrt(2.0 * one * other)


def _by_steps(z_m: FloatArray, step_m: float) -> float:
    """Relative error of a scale by heights ``(N,)`` in steps of ``step_m``, which no repetition removes.

    A height errs by the same whenever the drone passes it again. The slope of the rounded height over an even motion
    through ``m`` steps is wrong by ``-1 / m**2`` (from edge to edge) to ``+1 / (2 m**2)`` (from middle to middle).
    """
    return min(1.0, (step_m / max(float(np.ptp(z_m)), 1e-6)) ** 2)


class TelemetryScale:
    """Scale from displacements and height at one moment; `SensorGate` learns what the heights are worth.

    Args:
        config: Settings.
        T_b_c: Camera in the body ``(4, 4)`` [m].
        present: What is remembered.
        trust: Which readings may be used.
        delay_s: Video delay behind telemetry.
        turned: How the map is turned against the power-on world.
        held: Scale that was believed before [metres per map unit].
        flying: Whether the present scale is asked for, of a map that drifts; in the end one scale holds for all of it.
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
        """Scale for readings rounded to the nearest step or truncated; ``None`` where nothing tells.

        The mean of both, weighted by how probable each is; its sigma spans them while that is open. The better one of
        them explains the sweeps through zero and the displacements that the images show, and the less it puts velocity
        and height at odds, the more probable it is.
        """
        config = self._config
        fixed = {"nearest": Rounding.NEAREST, "truncate": Rounding.TRUNCATE}.get(config.velocity_rounding)
        sweeps = 0.0 if fixed else self._present.track.truncation_log_odds(config.velocity_step_m_s)
        systematic = {
            Rounding.NEAREST: config.systematic_log,
            Rounding.TRUNCATE: config.truncation_systematic_log,
        }
        tried = (Rounding.NEAREST, Rounding.TRUNCATE) if fixed is None else (fixed,)
        moved = {r: self._by_displacements(r) for r in tried}
        compared = all(evidence is not None for evidence in moved.values())
        if not compared:  # what cannot be compared is not chosen from
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
        return self._unless_parted(LogScale(mean, math.sqrt(variance), "+".join(fit.sources)), fit)

    def _unless_parted(self, before: LogScale, fit: TelemetryFit) -> tuple[LogScale, TelemetryFit]:
        """What the flight says, or the last seconds where these leave no room for it."""
        now = (self._at_present() or self._lately()) if self._flying else None
        if now is None or not at_odds(now, before):
            self._trust.parted = None
            return before, fit
        self._trust.parted = Parted(now, before)
        scale = math.exp(now.log_scale)
        return now, replace(fit, moved=None, sources={"telemetry": SourceScale(scale, scale * now.sigma)})

    def _lately(self) -> LogScale | None:
        """A present scale found before, less sure of itself each time that nothing new tells one."""
        last = self._trust.parted
        return None if last is None else replace(last.now, sigma=math.hypot(last.now.sigma, _FADING))

    def _at_present(self) -> LogScale | None:
        """By the displacements of the last seconds, if telemetry is of this flight."""
        last = self._present.memory.last
        shown = self._compared(by_told=True) if self._trust.proven and last is not None else None
        if shown is None or last is None:
            return None
        moved, step = shown.intervals, self._config.velocity_step_m_s
        late = moved.to_s > last.stamp_s - self._delay_s - PRESENT_S
        seen = moved.moved @ self._R_w_m.T
        now = present_scale(seen[late], shown.told[late], moved.duration_s[late], step)
        return now if now is not None and has_changed(now, seen[~late], shown.told[~late]) else None

    def _together(self, rounding: Rounding, moved: Evidence | None, systematic: float) -> _Hypothesis | None:
        tilt = self._tilt_rad
        rough = self._rough(moved)
        if rough is None:
            return None
        velocity = self._alone("telemetry", moved, systematic, rough)
        # What velocities do not know as well as the units of views differ by, they do not rule out.
        vouching = moved if velocity is not None and velocity.sigma < _OF_A_VIEW else None
        given = [g for g in (velocity, self._height_alone(rough, vouching)) if g is not None]
        odds = self._at_odds(*given) if len(given) == 2 else None
        if odds is not None and odds.kept is not None:
            given = [g for g in given if g.name == odds.kept]
            if odds.kept == "height":  # no surer than without the velocities that were wrong
                given = [g for g in (self._height_alone(rough, None),) if g is not None]
        elif [g.name for g in given] == ["height"] and self._nonsense(given[0]):
            given = []
        together = solved([g.evidence for g in given], tilt) if given else None
        if together is None:
            return None
        gap = parted_log = 0.0
        if len(given) == 2:
            one, other = (g.opinion for g in given)
            gap = abs(one.log_scale - other.log_scale) / math.hypot(one.sigma, other.sigma)
            if contradict(one, other):  # one of them is wrong: the sigma covers both
                parted_log = abs(one.log_scale - other.log_scale)
        sources = {g.name: SourceScale(g.scale, g.scale * g.sigma) for g in given}
        # Birge ratio: sources that disagree beyond their sigmas widen the result.
        sigma = max(parted_log, max(1.0, gap) * math.hypot(together[1], _shared_drift(given)))
        log_odds = (0.0 if moved is None else moved.log_likelihood) - 0.5 * min(gap, CONTRADICTION) ** 2
        moved = moved if "telemetry" in sources else None
        shortfall_m_s = 0.5 * self._config.velocity_step_m_s if rounding is Rounding.TRUNCATE else 0.0
        fit = TelemetryFit(moved, sources, shortfall_m_s)
        return _Hypothesis(math.log(together[0]), sigma, log_odds, fit, odds)

    def _alone(self, name: str, evidence: Evidence | None, systematic: float, rough: float) -> _Given | None:
        """What one kind of evidence says, with the error that no averaging removes."""
        if evidence is None:
            return None
        evidence = evidence.softened(systematic * rough)
        single = solved([evidence], self._tilt_rad)
        return None if single is None or single[1] >= _MOST_SIGMA else _Given(name, evidence, *single)

    def _height_alone(self, rough: float, moved: Evidence | None) -> _Given | None:
        return self._alone("height", self._by_height(rough, moved), self._config.height_systematic_log, rough)

    def _at_odds(self, velocity: _Given, height: _Given) -> AtOdds | None:
        """Velocities and heights that cannot both be right, and which one the depth network confirms, if it does."""
        one, other = velocity.opinion, height.opinion
        if not at_odds(one, other):
            return None
        kept = sided_with(one, other, self._present.network)
        return AtOdds(velocity.scale, height.scale, None if kept is None else kept.source)

    def _nonsense(self, height: _Given) -> bool:
        """Whether velocities that cannot tell the scale themselves still leave no room for that of heights alone.

        Where the map's first second is wrong, a climb of decimetres in it is, too, and nothing else asks. Velocities
        that go with the images to a quarter tell a scale to some tenths by the length of the way.
        """
        told = self._trust.latest.get(Reading.VELOCITY)
        if told is None or told.count < _LEAST_MOVING or told.share < _LEAST_SHARE:
            return False
        shown = self._shown or self._compared()
        if shown is None or not at_odds(height.opinion, LogScale(math.log(shown.start), _ROUGH_LOG, "telemetry")):
            return False
        self._trust.at_odds = AtOdds(shown.start, height.scale, None)
        return True

    def _rough(self, moved: Evidence | None) -> float | None:
        """Metres per map unit to look for floor steps with: by velocities, unless the network contradicts them."""
        network = self._present.network
        alone = None if moved is None else solved([moved], self._tilt_rad)
        if alone is None:
            known = self._present.rough_scale
            return self._shown.start if known is None and self._shown is not None else known
        wrong = network is not None and contradict(LogScale(math.log(alone[0]), alone[1], "telemetry"), network)
        return self._present.rough_scale if wrong else alone[0]

    def _by_displacements(self, rounding: Rounding) -> Evidence | None:
        """Velocities against displacements: the scale at which their remainders are what the images make expect."""
        shown = self._shown
        if shown is None:
            return None
        tilt, step = self._tilt_rad, self._config.velocity_step_m_s
        intervals, told = shown.intervals, shown.told
        scale = shown.start
        for _ in range(_MOST_ROUNDS):
            lost = shown.velocity.lost(shown.ends_s, scale, step, rounding)
            whole = told + lost[len(intervals) :] - lost[: len(intervals)]
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
        # A scale that may wander explains what truncation leaves out as well: the roundings compare without that.
        rigid = self._evidence(intervals, whole, None) if self._flying else evidence
        if rigid is None:
            return None
        return replace(self._with_drift(softened, rigid), log_likelihood=rigid.log_likelihood)

    def _with_drift(self, evidence: Evidence, rigid: Evidence) -> Evidence:
        """Evidence of the present scale, and how much less sure it is than that of a scale which never changes."""
        pair = [solved([e], self._tilt_rad) for e in (evidence, rigid)]
        if pair[0] is None or pair[1] is None:
            return evidence
        return replace(evidence, drift_sigma=math.sqrt(max(0.0, pair[0][1] ** 2 - pair[1][1] ** 2)))

    def _evidence(self, moved: Displacements, moved_m: FloatArray, aged: FloatArray | None) -> Evidence | None:
        config = self._config
        return displacement_evidence(
            moved.moved @ self._R_w_m.T,
            moved_m,
            moved.from_s,
            moved.duration_s,
            moved.sigma,
            config.sigma_velocity_m_s * np.sqrt(0.1 * moved.duration_s),
            self._tilt_rad,
            aged,
        )

    def _aged(self, stamps_s: FloatArray) -> FloatArray | None:
        """How much the map has aged since each time ``(N,)`` of telemetry's clock; None where that is of no matter."""
        memory = self._present.memory
        if not self._flying or memory.last is None:
            return None
        return aged_since(stamps_s + self._delay_s, memory.began_s, memory.last.stamp_s)

    def _compared(self, by_told: bool = False) -> _Shown | None:
        """Intervals in which the drone moves, as images and readings have them; ``by_told`` asks the readings which."""
        track, config, memory = self._present.track, self._config, self._present.memory
        moved = memory.displacements()
        if len(moved) == 0:
            return None
        use = track.covered(moved.from_s - self._delay_s, moved.to_s - self._delay_s)
        if use.sum() < 2:
            return None
        moved = moved.only(use).joined().on_telemetry_clock(self._delay_s)
        R_from, R_to = track.attitude(moved.from_s), track.attitude(moved.to_s)
        told = track.displacement(np.concatenate([moved.from_s, moved.to_s]))
        moved_m = told[len(moved) :] - told[: len(moved)] + (R_to - R_from) @ self._T_b_c[:3, 3]
        moving = self._moving(moved, moved_m, by_told)
        if moving.sum() < 2:
            return None
        moved, moved_m = moved.only(moving), moved_m[moving]
        ways = float(np.sum(moved_m**2)), float(np.sum(moved.moved**2))
        if min(ways) <= 0.0:
            return None
        seen = memory.sightings()
        velocity = seen_velocity(track, seen, self._delay_s, self._R_w_m, self._T_b_c, config.max_gap_s)
        return _Shown(moved, moved_m, velocity, math.sqrt(ways[0] / ways[1]))

    def _moving(self, moved: Displacements, moved_m: FloatArray, by_told: bool) -> np.ndarray:
        """Intervals fast enough to speak of scale, judged by vision once the scale is roughly known."""
        if self._held is not None and not by_told:
            speed = np.linalg.norm(moved.moved, axis=1) * self._held / moved.duration_s
        else:
            speed = np.linalg.norm(moved_m, axis=1) / moved.duration_s
        return speed > self._config.min_speed_m_s

    def _by_height(self, scale: float, moved: Evidence | None) -> Evidence | None:
        """The best of range, SDK height and barometer: they watch the same motion."""
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
            # A reading between two sightings, not the other way round: each counts once.
            here = (times >= stamps_s[0]) & (times <= stamps_s[-1])
            near = np.clip(np.searchsorted(stamps_s, times), 1, len(stamps_s) - 1)
            here &= stamps_s[near] - stamps_s[near - 1] < config.max_gap_s
            if here.sum() < 2:
                continue
            p = np.stack([np.interp(times[here], stamps_s, p_w[:, k]) for k in range(3)], axis=1)
            sigma = getattr(config, _HEIGHT_SOURCES[name])
            segment = floor_segments(times[here], z[here], scale * p[:, 2], step_m=max(0.08, 4.0 * sigma))
            self._judge_height(Reading(name), p[:, 2:], z[here, None], times[here], segment, scale)
            if not self._trust.height(Reading(name)):
                continue
            if moved is None and self._trust.latest[Reading(name)].count < _LEAST_CHANGES:
                continue
            tilt = self._tilt_rad
            aged, wander = self._aged(times[here]), self._wander(moved)
            if moved is None:
                by_views = np.interp(times[here], stamps_s, self._of_other_views(seen.T, wander))
                aged = by_views if aged is None else aged + by_views
            evidence = height_evidence(p, z[here], times[here], segment, sigma_map, sigma, scale, tilt, aged, wander)
            if evidence is not None:
                evidence = evidence.softened(scale * _by_steps(z[here], _HEIGHT_STEP_M[name]))
            single = solved([evidence], tilt) if evidence is not None else None
            if evidence is not None and single is not None and single[1] < best_sigma:
                if aged is not None:
                    rigid = height_evidence(p, z[here], times[here], segment, sigma_map, sigma, scale, tilt)
                    evidence = evidence if rigid is None else self._with_drift(evidence, rigid)
                best, best_sigma = evidence, single[1]
            if best_sigma < _GOOD_HEIGHT:
                break
        return best

    def _of_other_views(self, T: FloatArray, wander: float) -> FloatArray:
        """How much more a map has aged ``(N,)`` that wanders so, as it turned away from what it showed at ``T``."""
        by_view = max(_OF_A_VIEW, self._present.network_wander_log)
        return turned_since(T) * (by_view / wander) ** 2

    def _wander(self, moved: Evidence | None) -> float:
        """How much the map's scale changes as it ages: by the displacements, if they tell.

        Velocities that had motion enough to prove themselves, have not, and leave a fifth of the way unexplained: a map
        that changes its scale on the way is what parts them from the images.
        """
        if moved is not None:
            return moved.wander
        tried = self._trust.latest.get(Reading.VELOCITY)
        if tried is None or self._trust.verdict(Reading.VELOCITY) is Verdict.CONTRADICTS:  # of no such flight
            return USUAL_WANDER
        parted = tried.count >= LEAST_COUNT and tried.steady < _EXPLAINED
        return MOST_WANDER if parted else USUAL_WANDER

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
        least = max(_LEAST_CLIMB_M, _LEAST_CLIMB_SIGMAS * getattr(self._config, _HEIGHT_SOURCES[reading]))
        seen, told = (changes(z, stamps_s, segment, _HEIGHT_BIN_S) for z in (z_map, z_m))
        self._trust.judge(reading, agreement(seen, told, least / scale, least))
