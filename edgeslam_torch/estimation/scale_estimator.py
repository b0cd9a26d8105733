"""Metres per map unit from telemetry, the depth network and an earlier flight."""

import math
from collections.abc import Sequence
from dataclasses import replace

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.scale.consensus import Settled, settled_with_network
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio, DepthRatios, DepthScale
from edgeslam_torch.estimation.scale.log_scale import LogScale, fuse
from edgeslam_torch.estimation.telemetry.sensor_validation import HEIGHTS, SensorGate
from edgeslam_torch.estimation.telemetry_scale import TelemetryFit
from edgeslam_torch.noise import DEPTH_SCALE_LOG
from edgeslam_torch.types import ScaleEstimate

_BELIEVED = 0.3
"""Maximum relative sigma of a scale from telemetry."""
_SURE = 0.15
"""Maximum relative sigma of a scale from heights alone with which velocities constrain the map: with a scale that is
wrong by several times they would distort it."""
_FOCAL_SHARE = 0.4
"""Share of a focal length's relative error that the scale from telemetry inherits; set on recordings with focal lengths
of 0.7 to 1.5 times the true one."""

Found = tuple[LogScale, TelemetryFit]
"""A scale by telemetry, and the details of its fit."""


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
        """Details of the fit of `sensor_scale`."""
        self.sensor_scale: LogScale | None = None
        """Scale by the drone's own sensors; unchanged without new measurements."""
        self.guess: ScaleEstimate | None = None
        """Scale by a climb before telemetry is validated; None afterwards. Not metric: only a better initial value of
        the published scale than the depth network's."""
        self.inertial: LogScale | None = None
        """Scale by an IMU; None while it is not observable."""
        self._remembered: LogScale | None = None
        self._scale = ScaleEstimate()
        self._rests_on: tuple[LogScale | DepthScale | None, ...] = ()

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
        if scale is None or not math.isfinite(scale.sigma):
            self._remembered = None
        else:
            self._remembered = LogScale(math.log(scale.value), scale.sigma / scale.value, "atlas")

    def take(self, found: Found | None, trust: SensorGate) -> None:
        """Update with telemetry.

        Args:
            found: Its scale.
            trust: Usable readings; a scale that rests on others is dropped.
        """
        if found is not None:
            self.fit = found[1]
        if found is not None and found[0].sigma < _BELIEVED:
            self.sensor_scale = found[0]
        elif not self._still_trusted(trust) or self._of_heights():
            self.sensor_scale, self.fit = None, TelemetryFit(shortfall_m_s=self.fit.shortfall_m_s)
        # else no new information: hover, pure rotation, or no telemetry

    def provisional_scale(self, found: Found | None) -> None:
        """Update the guess with heights that are not validated yet."""
        self.guess = None
        if found is not None and found[0].sigma < _BELIEVED:
            self.guess = _estimate(found[0])

    def follow(self, log_ratio: float) -> None:
        """Adapt the scale to a map that has grown by ``exp(log_ratio)``."""
        if self.sensor_scale is not None:
            self.sensor_scale = replace(self.sensor_scale, log_scale=self.sensor_scale.log_scale - log_ratio)

    def _of_heights(self) -> bool:
        """Whether the scale rests on heights alone, which are void once the map's vertical has changed."""
        return self.sensor_scale is not None and self.sensor_scale.source == "height"

    def _still_trusted(self, trust: SensorGate) -> bool:
        """Whether all sources of the present scale are still usable."""
        trusted = {"telemetry": trust.velocity and trust.tells_scale, "height": any(map(trust.height, HEIGHTS))}
        settled = trust.at_odds is None or trust.at_odds.kept is not None
        return settled and all(trusted[source] for source in self.fit.sources)

    # --- output --------------------------------------------------------------------------------------------------

    def scale(self) -> ScaleEstimate:
        """Metres per map unit with sigma and source; unchanged without new measurements."""
        rests_on = self._remembered, self.sensor_scale, self.inertial, self._depth.scale()
        if rests_on != self._rests_on:  # cached, since it is used several times a frame
            self._rests_on, self._scale = rests_on, fuse(self._settled().used)
        return self._scale

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

    def network(self) -> LogScale | None:
        """The depth network's estimate including the uncertainty of the focal length."""
        depth = self._depth.scale()
        return None if depth is None else self._with_focal(depth)

    def velocity_constrains_map(self, trust: SensorGate) -> bool:
        """Whether velocities may constrain the map: not with an inaccurate scale from heights alone."""
        measured = self.sensor_scale
        if measured is None or not ("telemetry" in measured.source or measured.sigma < _SURE):
            return False
        return self.velocity_is_right(trust)

    def velocity_is_right(self, trust: SensorGate) -> bool:
        """Whether velocities are validated and consistent with the sources in use."""
        return trust.velocity and (trust.at_odds is None or trust.at_odds.kept == "telemetry")

    def sources(self) -> tuple[ScaleEstimate, ...]:
        """Scale by each source alone, used or not."""
        measured = [ScaleEstimate(s.value, s.sigma, name) for name, s in self.fit.sources.items()]
        others = self.inertial, self.network(), self._remembered
        measured += [_estimate(known) for known in others if known is not None]
        return tuple(measured)

    def contradiction(self) -> str | None:
        """Warning of contradicting sources."""
        return self._settled().warning

    def warnings(self) -> list[str]:
        """The same, and a warning of the depth network where its metres are needed."""
        depth = self._depth.scale() if self.sensor_scale is None and self.inertial is None else None
        own = (None if depth is None else depth.warning(), self.contradiction())
        return [said for said in own if said is not None]

    def statistics(self) -> dict[str, float]:
        """Each source, for the report."""
        numbers = {} if self.fit.moved is None else {"displacement residual m": self.fit.moved.rms_m}
        for name, source in self.fit.sources.items():
            numbers[f"scale {name}"], numbers[f"scale {name} sigma"] = source.value, source.sigma
        depth = self._depth.scale()
        return numbers if depth is None else numbers | depth.statistics()

    def _settled(self) -> Settled:
        """Estimates that may be averaged."""
        measured, depth = self.sensor_scale, self._depth.scale()
        if measured is not None:
            measured = replace(measured, sigma=math.hypot(measured.sigma, _FOCAL_SHARE * self._focal_sigma))
        if self.inertial is not None:  # a unit that cannot be mistaken, with a sigma that is below any network's
            return Settled(tuple(known for known in (self.inertial, measured) if known is not None))
        if self._remembered is not None:  # which includes the network's estimate
            return settled_with_network(measured, self._remembered, True)
        return settled_with_network(measured, self.network(), depth is not None and depth.in_domain)

    def _with_focal(self, depth: DepthScale) -> LogScale:
        """Map depth and network depth scale with the focal length: the ratio has its whole uncertainty."""
        return replace(depth.opinion, sigma=math.hypot(depth.sigma, self._focal_sigma))


def _estimate(known: LogScale) -> ScaleEstimate:
    value = math.exp(known.log_scale)
    return ScaleEstimate(value, value * known.sigma, known.source)
