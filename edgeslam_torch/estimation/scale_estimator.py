"""Metres per map unit: the belief of each source, and what is decided from them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.scale.belief import Decision, ScaleBelief, contradict, decide, mean
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio, DepthRatios
from edgeslam_torch.estimation.telemetry.sensor_validation import HEIGHTS, SensorGate
from edgeslam_torch.estimation.telemetry_scale import TelemetryFit
from edgeslam_torch.noise import DEPTH_SCALE_LOG, PATH_RATIO_LOG
from edgeslam_torch.types import ScaleEstimate

_BELIEVED = 0.3
"""Maximum relative sigma of a scale from telemetry."""
_SURE = 0.15
"""Relative sigma of the best depth networks: an IMU that is less sure is used along with one, and heights alone say
nothing of velocities."""
_FOCAL_SHARE = 0.4
"""Share of a focal length's relative error that the scale from telemetry inherits; set on recordings with focal lengths
of 0.7 to 1.5 times the true one."""
_TELEMETRY = "telemetry", "height"


class ScaleEstimator:
    """Scale of one map.

    Args:
        config: Settings.
        focal_sigma: Relative standard deviation of the camera's focal length; a wrong one bends the map and its scale.
    """

    def __init__(self, config: FusionConfig, focal_sigma: float) -> None:
        self._focal_sigma = focal_sigma
        self._depth = DepthRatios(DEPTH_SCALE_LOG)
        truncates = config.velocity_rounding == "truncate"
        self.fit = TelemetryFit(shortfall_m_s=0.5 * config.velocity_step_m_s if truncates else 0.0)
        """Details of the newest fit of velocities."""
        self.inertial: ScaleBelief | None = None
        """Scale by an IMU; None while it is not observable."""
        self._by_telemetry: dict[str, ScaleBelief] = {}
        """By velocities (``telemetry``) and ``height``; unchanged without new measurements."""
        self._remembered: ScaleBelief | None = None
        self._beliefs: tuple[ScaleBelief, ...] = ()
        self._decided, self._scale = Decision(), ScaleEstimate()

    # --- input ---------------------------------------------------------------------------------------------------

    def add_depth_ratio(self, ratio: DepthRatio) -> None:
        """Add the ratio of the network's depth to the map's in one keyframe."""
        self._depth.add(ratio)

    def replace_depth_ratios(self, ratios: Sequence[DepthRatio]) -> None:
        """Replace the ratios of all keyframes after a change of the map's scale."""
        self._depth = DepthRatios(DEPTH_SCALE_LOG)
        for ratio in ratios:
            self._depth.add(ratio)

    def remember(self, scale: ScaleEstimate | None) -> None:
        """Metres per unit of the camera's submap from an earlier flight; None for a new submap.

        It replaces the depth network's estimate, whose error in a place is the same in every flight.
        """
        self._remembered = None
        if scale is not None and math.isfinite(scale.sigma):
            self._remembered = ScaleBelief(math.log(scale.value), scale.sigma / scale.value, "atlas")

    def take(self, found: Mapping[str, ScaleBelief] | None, fit: TelemetryFit | None, trust: SensorGate) -> None:
        """Update with telemetry.

        Args:
            found: Its beliefs by source; empty where its readings determine no scale, None where none of them moved:
                then the previous ones stay.
            fit: Details of the fit.
            trust: Usable readings; previous beliefs that rest on others are dropped.
        """
        if fit is not None:
            self.fit = fit
        if found is not None:
            self._by_telemetry = dict(found)
            return
        trusted = {"telemetry": trust.velocity and trust.tells_scale, "height": any(map(trust.height, HEIGHTS))}
        # Heights alone are void once the map's vertical has changed.
        if set(self._by_telemetry) == {"height"} or not all(trusted[source] for source in self._by_telemetry):
            self._by_telemetry = {}

    # --- output --------------------------------------------------------------------------------------------------

    @property
    def decided(self) -> Decision:
        """Which sources are used; cached, since it is read several times a frame."""
        depth = self._depth.scale()
        beliefs = [self._with_common(b) for b in self._by_telemetry.values()]
        network = self.network() if self._remembered is None else self._remembered  # which includes the network's
        if self.inertial is not None:
            beliefs.append(self.inertial)
        if network is not None and (self.inertial is None or self.inertial.sigma > _SURE):
            beliefs.append(network)
        if tuple(beliefs) != self._beliefs:
            self._beliefs = tuple(beliefs)
            self._decided = decide(beliefs, only_witness=depth is not None and not depth.in_domain)
            others = [b for b in self._decided.used if b.source not in _TELEMETRY]
            sensors = self.sensor_scale
            inside = 0 if sensors is None else sensors.source.count("+")
            used = mean(([] if sensors is None else [sensors]) + others, inside)
            self._scale = ScaleEstimate() if used is None else used.estimate
        return self._decided

    @property
    def sensor_scale(self) -> ScaleBelief | None:
        """Scale by the drone's velocities and heights, if they are accurate enough."""
        used = {b.source for b in self.decided.used}
        measured = mean([belief for name, belief in self._by_telemetry.items() if name in used])
        if measured is None or math.hypot(measured.sigma, self.fit.noise_log) >= _BELIEVED:
            return None
        return self._with_common(measured)

    def scale(self) -> ScaleEstimate:
        """Metres per map unit with sigma and source; unchanged without new measurements."""
        return self._scale if self.decided.used else ScaleEstimate()

    def previous_scale(self) -> float | None:
        """Scale by telemetry alone."""
        return None if self.sensor_scale is None else math.exp(self.sensor_scale.log_scale)

    def network_unit(self) -> float | None:
        """Scale by the depth network alone; None before the first comparison."""
        depth = self._depth.scale()
        return None if depth is None else math.exp(depth.log_scale)

    def rough(self) -> float | None:
        """Rough scale, for thresholds on motion."""
        unit = self.network_unit()
        return self.previous_scale() if unit is None else unit

    def network(self) -> ScaleBelief | None:
        """The depth network's estimate. Map depth and network depth scale with the focal length: their ratio has its
        whole uncertainty."""
        depth = self._depth.scale()
        return None if depth is None else self._with_focal(depth.belief, 1.0)

    def _with_common(self, belief: ScaleBelief) -> ScaleBelief:
        """With the errors that velocities and heights share: those of the map that both are compared with."""
        return self._with_focal(replace(belief, sigma=math.hypot(belief.sigma, self.fit.noise_log)), _FOCAL_SHARE)

    def _with_focal(self, belief: ScaleBelief, share: float) -> ScaleBelief:
        """With a share of the focal length's error, which is common to all that a source measures."""
        return replace(belief, sigma=math.hypot(belief.sigma, share * self._focal_sigma))

    def uses_velocity(self, trust: SensorGate) -> bool:
        """Whether velocities may constrain the map and predict poses: at a scale that they determine, or that heights
        do and the length of their path does not contradict. Those in another unit would stretch the map."""
        measured, ratio = self.sensor_scale, self.fit.path_ratio
        if measured is None or not trust.velocity:
            return False
        if "telemetry" in measured.source:
            return True
        by_path = None if ratio is None else ScaleBelief(math.log(ratio), PATH_RATIO_LOG, "telemetry")
        return measured.sigma < _SURE and by_path is not None and not contradict(measured, by_path)

    def sources(self) -> tuple[ScaleEstimate, ...]:
        """Scale by each source alone, used or not; without sensors that others have outvoted."""
        outvoted = self.decided.rejected if self.decided.used else frozenset()
        sensors = [b for name, b in self._by_telemetry.items() if name not in outvoted]
        return tuple(b.estimate for b in (*sensors, self.inertial, self.network(), self._remembered) if b is not None)

    def contradiction(self) -> str | None:
        """Warning of contradicting sources."""
        return self.decided.warning

    def warnings(self) -> list[str]:
        """The same, and a warning of the depth network where its metres are needed."""
        depth = self._depth.scale() if self.sensor_scale is None and self.inertial is None else None
        own = (None if depth is None else depth.warning(), self.contradiction())
        return [said for said in own if said is not None]

    def statistics(self) -> dict[str, float]:
        """Each source, for the report."""
        numbers = {} if self.fit.rms_m is None else {"displacement residual m": self.fit.rms_m}
        for name, belief in self._by_telemetry.items():
            known = belief.estimate
            numbers[f"scale {name}"], numbers[f"scale {name} sigma"] = known.value, known.sigma
        depth = self._depth.scale()
        return numbers if depth is None else numbers | depth.statistics()
