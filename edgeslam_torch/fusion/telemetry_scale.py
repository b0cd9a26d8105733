"""Metric scale from the drone's velocities and heights: what they say of the map, alone and together."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.scale.consensus import at_odds, contradict, sided_with
from edgeslam_torch.fusion.scale.joint_scale import Evidence, displacement_evidence, height_evidence, solved
from edgeslam_torch.fusion.scale.log_scale import LogScale, floor_segments
from edgeslam_torch.fusion.telemetry.comparison import FlightSoFar
from edgeslam_torch.fusion.telemetry.plausibility import AtOdds, Reading, Trust, agreement, changes
from edgeslam_torch.fusion.telemetry.visual_memory import Displacements
from edgeslam_torch.types import FloatArray, IntArray

_IMPROBABLE = 1e-4
_MOST_GAP = 6.0
"""Sigmas between velocity and height beyond which one hypothesis is not made any less probable."""
_MOST_SIGMA = 0.5
"""Relative sigma beyond which a source on its own says nothing."""
_GOOD_HEIGHT = 0.2
"""Relative sigma with which a height source is good enough; the next one would say the same less well."""
_HEIGHT_BIN_S = 0.5
_HEIGHT_SOURCES = {"tof": "sigma_tof_m", "h": "sigma_h_m", "baro": "sigma_baro_m"}
_LEAST_CLIMB_M = 0.05
_LEAST_CLIMB_SIGMAS = 2.0
_MOST_STEPS = 0.3
"""Share of height readings that may step: more is not furniture passing below."""


@dataclass(frozen=True, slots=True)
class SourceScale:
    """Scale by one source on its own."""

    value: float
    """Metres per map unit."""
    sigma: float


@dataclass(frozen=True, slots=True)
class TelemetryFit:
    """What the newest fit found, for prediction and for the report."""

    moved: Evidence | None = None
    """From displacements."""
    sources: dict[str, SourceScale] = field(default_factory=dict)
    """Velocities (``telemetry``) and ``height`` on their own."""
    shortfall_m_s: float = 0.0
    """How much every velocity that is not zero reads low, as likely as not."""


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Scale under one reading of the velocities: rounded to the nearest step, or truncated."""

    log_scale: float
    sigma: float
    gap: float
    """How far velocity and height are apart, in sigmas of the difference."""
    fit: TelemetryFit


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


class TelemetryScale:
    """Scale from displacements and height at one moment; `Trust` learns what the heights are worth.

    Args:
        config: Settings.
        T_b_c: Camera in the body ``(4, 4)`` [m].
        present: What is remembered.
        trust: Which readings may be used.
        delay_s: Video delay behind telemetry.
        R_w_m: Map axes to the power-on world ``(3, 3)``.
        held: Scale that was believed before [metres per map unit].
    """

    def __init__(
        self,
        config: FusionConfig,
        T_b_c: FloatArray,
        present: FlightSoFar,
        trust: Trust,
        delay_s: float,
        R_w_m: FloatArray,
        held: float | None,
    ) -> None:
        self._config, self._T_b_c = config, T_b_c
        self._present, self._trust = present, trust
        self._delay_s, self._R_w_m, self._held = delay_s, R_w_m, held

    def opinion(self) -> tuple[LogScale, TelemetryFit] | None:
        """Scale for readings rounded to the nearest step or truncated; ``None`` where nothing tells.

        The mean of both, weighted by how probable each is; its sigma spans them while that is open. Readings that would
        put velocity and height at odds are so much the less probable.
        """
        config = self._config
        half = 0.5 * config.velocity_step_m_s
        share = {"nearest": 0.0, "truncate": 1.0}.get(config.velocity_rounding)
        if share is None:
            share = self._present.track.truncation_probability(config.velocity_step_m_s)
        mixed: list[tuple[float, _Hypothesis]] = []
        for probability, shortfall_m_s, systematic in (
            (1.0 - share, 0.0, config.systematic_log),
            (share, half, config.truncation_systematic_log),
        ):
            if probability < _IMPROBABLE:
                continue
            found = self._together(shortfall_m_s, systematic)
            if found is not None:
                mixed.append((probability * math.exp(-0.5 * min(found.gap, _MOST_GAP) ** 2), found))
        if not mixed:
            return None
        best = max(mixed, key=lambda m: m[0])[1]
        total = sum(p for p, _ in mixed)
        mean = sum(p * o.log_scale for p, o in mixed) / total
        variance = sum(p * (o.sigma**2 + (o.log_scale - mean) ** 2) for p, o in mixed) / total
        return LogScale(mean, math.sqrt(variance), "+".join(best.fit.sources)), best.fit

    def _together(self, shortfall_m_s: float, systematic: float) -> _Hypothesis | None:
        tilt = self._config.alignment_sigma_rad
        moved = self._by_displacements(shortfall_m_s) if self._trust.velocity else None
        rough = self._rough(moved)
        if rough is None:
            return None
        height = self._by_height(rough)
        given = [
            g
            for g in (
                self._alone("telemetry", moved, systematic, rough),
                self._alone("height", height, self._config.height_systematic_log, rough),
            )
            if g is not None
        ]
        if len(given) == 2 and at_odds(given[0].opinion, given[1].opinion):
            given = self._settled(*given)
        together = solved([g.evidence for g in given], tilt) if given else None
        if together is None:
            return None
        gap = 0.0
        if len(given) == 2:
            one, other = (g.opinion for g in given)
            gap = abs(one.log_scale - other.log_scale) / math.hypot(one.sigma, other.sigma)
        sources = {g.name: SourceScale(g.scale, g.scale * g.sigma) for g in given}
        # Birge ratio: sources that disagree beyond their sigmas widen the result.
        sigma = max(1.0, gap) * together[1]
        moved = moved if "telemetry" in sources else None
        return _Hypothesis(math.log(together[0]), sigma, gap, TelemetryFit(moved, sources, shortfall_m_s))

    def _alone(self, name: str, evidence: Evidence | None, systematic: float, rough: float) -> _Given | None:
        """What one kind of evidence says, with the error that no averaging removes."""
        if evidence is None:
            return None
        evidence = evidence.softened(systematic * rough)
        single = solved([evidence], self._config.alignment_sigma_rad)
        return None if single is None or single[1] >= _MOST_SIGMA else _Given(name, evidence, *single)

    def _settled(self, velocity: _Given, height: _Given) -> list[_Given]:
        """Of velocities and heights that cannot both be right the one that the depth network confirms, if it does."""
        kept = sided_with(velocity.opinion, height.opinion, self._present.network)
        self._trust.at_odds = AtOdds(velocity.scale, height.scale, None if kept is None else kept.source)
        return [given for given in (velocity, height) if kept is not None and given.name == kept.source]

    def _rough(self, moved: Evidence | None) -> float | None:
        """Metres per map unit to look for floor steps with: by velocities, unless the network contradicts them."""
        network = self._present.network
        alone = None if moved is None else solved([moved], self._config.alignment_sigma_rad)
        if alone is None:
            return self._present.rough_scale
        wrong = network is not None and contradict(LogScale(math.log(alone[0]), alone[1], "telemetry"), network)
        return self._present.rough_scale if wrong else alone[0]

    def _by_displacements(self, shortfall_m_s: float) -> Evidence | None:
        track, config = self._present.track, self._config
        moved = self._present.memory.displacements()
        if len(moved) == 0:
            return None
        use = track.covered(moved.from_s - self._delay_s, moved.to_s - self._delay_s)
        if use.sum() < 2:
            return None
        moved = moved.only(use).joined().on_telemetry_clock(self._delay_s)
        R_from, R_to = track.attitude(moved.from_s), track.attitude(moved.to_s)
        told = track.displacement(np.concatenate([moved.from_s, moved.to_s]), shortfall_m_s)
        moved_m = told[len(moved) :] - told[: len(moved)] + (R_to - R_from) @ self._T_b_c[:3, 3]
        moving = self._moving(moved, moved_m)
        if moving.sum() < 2:
            return None
        moved, moved_m = moved.only(moving), moved_m[moving]
        duration_s = moved.duration_s
        return displacement_evidence(
            moved.moved @ self._R_w_m.T,
            moved_m,
            moved.from_s,
            duration_s,
            moved.sigma,
            config.sigma_velocity_m_s * np.sqrt(0.1 * duration_s),
            config.alignment_sigma_rad,
        )

    def _moving(self, moved: Displacements, moved_m: FloatArray) -> np.ndarray:
        """Intervals fast enough to speak of scale, judged by vision once the scale is roughly known."""
        if self._held is not None:
            speed = np.linalg.norm(moved.moved, axis=1) * self._held / moved.duration_s
        else:
            speed = np.linalg.norm(moved_m, axis=1) / moved.duration_s
        return speed > self._config.min_speed_m_s

    def _by_height(self, scale: float) -> Evidence | None:
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
            tilt = config.alignment_sigma_rad
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
        least = max(_LEAST_CLIMB_M, _LEAST_CLIMB_SIGMAS * getattr(self._config, _HEIGHT_SOURCES[reading]))
        seen, told = (changes(z, stamps_s, segment, _HEIGHT_BIN_S) for z in (z_map, z_m))
        self._trust.judge(reading, agreement(seen, told, least / scale, least))
