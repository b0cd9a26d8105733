"""Metres per map unit: what telemetry, the depth network and an earlier flight say, and what is made of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.scale.consensus import Settled, settled_with_network
from edgeslam_torch.fusion.scale.depth_scale import DepthRatio, DepthRatios, DepthScale
from edgeslam_torch.fusion.scale.log_scale import LogScale, fuse
from edgeslam_torch.fusion.telemetry.sensor_validation import HEIGHTS, SensorGate
from edgeslam_torch.fusion.telemetry_scale import TelemetryFit
from edgeslam_torch.types import ScaleEstimate

_BELIEVED = 0.3
"""Relative sigma of a scale from telemetry that is used."""
_SURE = 0.15
"""Relative sigma of a scale by heights alone by which velocities pull at the map: half of what is believed, so that two
sigmas are a third and not more than a half. A scale that is wrong by several times tears the map by them."""
_FOCAL_SHARE = 0.4
"""How much of a focal length's error the scale from telemetry takes on: with 0.7 to 1.5 times the right one the root
mean square over fr1_xyz, redkitchen and euroc_mh05_a is 0.4 in the logarithm."""

Found = tuple[LogScale, TelemetryFit]
"""A scale by telemetry, and how it was found."""


class ScaleEstimator:
    """Scale of one map.

    Args:
        config: Settings.
        focal_sigma: Relative standard deviation of the camera's focal length; a wrong one bends the map and its scale.
    """

    def __init__(self, config: FusionConfig, focal_sigma: float) -> None:
        self._depth_bias_log, self._focal_sigma = config.depth_bias_log, focal_sigma
        self._depth = DepthRatios(self._depth_bias_log)
        truncates = config.velocity_rounding == "truncate"
        self.fit = TelemetryFit(shortfall_m_s=0.5 * config.velocity_step_m_s if truncates else 0.0)
        """How `told` was found."""
        self.told: LogScale | None = None
        """Scale by the drone's own sensors; held while they say nothing new."""
        self.guess: ScaleEstimate | None = None
        """Scale by a climb before anything has proven that telemetry is of this flight; None after that. No claim of
        metres: a better guess of the published unit than the depth network's."""
        self._remembered: LogScale | None = None
        self._scale = ScaleEstimate()
        self._rests_on: tuple[LogScale | None, LogScale | None, DepthScale | None] = (None, None, None)

    # --- what is said --------------------------------------------------------------------------------------------

    def add_depth_ratio(self, ratio: DepthRatio) -> None:
        """How one keyframe's network depth compares with the map's."""
        self._depth.add(ratio)

    def replace_depth_ratios(self, ratios: Sequence[DepthRatio]) -> None:
        """The same of all keyframes, once the map has another unit."""
        self._depth = DepthRatios(self._depth_bias_log)
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

    def take(self, found: Found | None, unrest: float, trust: SensorGate) -> None:
        """What telemetry says now.

        Args:
            found: Its scale.
            unrest: Relative error of that because the map still moves.
            trust: Which readings may be used: what rests on others is forgotten.
        """
        if found is not None:
            self.fit = found[1]
        if found is not None and found[0].sigma < _BELIEVED:
            self.told = replace(found[0], sigma=math.hypot(found[0].sigma, unrest))
        elif not self._still_trusted(trust) or self._of_heights():
            self.told, self.fit = None, TelemetryFit(shortfall_m_s=self.fit.shortfall_m_s)
        # else nothing new to say: hover, pure rotation, or telemetry missing

    def provisional_scale(self, found: Found | None, unrest: float) -> None:
        """What heights would say if they were of this flight; as in `take`."""
        self.guess = None
        if found is not None and (sigma := math.hypot(found[0].sigma, unrest)) < _BELIEVED:
            value = math.exp(found[0].log_scale)
            self.guess = ScaleEstimate(value, value * sigma, found[0].source)

    def follow(self, log_ratio: float) -> None:
        """Take the scale along with a map that has grown by ``exp(log_ratio)``."""
        if self.told is not None:
            self.told = replace(self.told, log_scale=self.told.log_scale - log_ratio)

    def _of_heights(self) -> bool:
        """Whether heights alone had told the scale: of a map that has turned away from what they had seen they tell
        nothing any more."""
        return self.told is not None and self.told.source == "height"

    def _still_trusted(self, trust: SensorGate) -> bool:
        """Whether all that the held opinion rests on may still tell the scale."""
        trusted = {"telemetry": trust.velocity and trust.tells_scale, "height": any(map(trust.height, HEIGHTS))}
        settled = trust.at_odds is None or trust.at_odds.kept is not None
        return settled and all(trusted[source] for source in self.fit.sources)

    # --- what is made of it --------------------------------------------------------------------------------------

    def scale(self) -> ScaleEstimate:
        """Metres per map unit with sigma and source; held while the motion says nothing new."""
        rests_on = self._remembered, self.told, self._depth.scale()
        if rests_on != self._rests_on:  # it is asked for several times a frame
            self._rests_on, self._scale = rests_on, fuse(self._settled().used)
        return self._scale

    def held(self) -> float | None:
        """By telemetry alone."""
        return None if self.told is None else math.exp(self.told.log_scale)

    def network_unit(self) -> float | None:
        """By the depth network, right or wrong; None before anything has been compared."""
        depth = self._depth.scale()
        return None if depth is None else math.exp(depth.log_scale)

    def network_wander_log(self) -> float:
        """By how much the depth network's ratio to the map changes from keyframe to keyframe."""
        depth = self._depth.scale()
        return 0.0 if depth is None else depth.wander_log

    def rough(self) -> float | None:
        """For what counts as motion."""
        unit = self.network_unit()
        return self.held() if unit is None else unit

    def network(self) -> LogScale | None:
        """The depth network's opinion with the focal length's doubt."""
        depth = self._depth.scale()
        return None if depth is None else self._with_focal(depth)

    def velocity_speaks(self, trust: SensorGate) -> bool:
        """Whether velocities may pull at the map: not by metres that heights alone told, and hardly know."""
        told = self.told
        if told is None or not ("telemetry" in told.source or told.sigma < _SURE):
            return False
        return self.velocity_is_right(trust)

    def velocity_is_right(self, trust: SensorGate) -> bool:
        """Whether velocities are this flight's, and nothing that is used instead contradicts them."""
        return trust.velocity and (trust.at_odds is None or trust.at_odds.kept == "telemetry")

    def sources(self) -> tuple[ScaleEstimate, ...]:
        """Scale by each source alone, used or not."""
        told = [ScaleEstimate(s.value, s.sigma, name) for name, s in self.fit.sources.items()]
        told += [_estimate(known) for known in (self.network(), self._remembered) if known is not None]
        return tuple(told)

    def contradiction(self) -> str | None:
        """That sources contradict each other, in words."""
        return self._settled().warning

    def warnings(self) -> list[str]:
        """The same, and what is wrong with the depth network here, where its metres are needed."""
        depth = self._depth.scale() if self.told is None else None
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
        """Opinions that may be averaged."""
        told, depth = self.told, self._depth.scale()
        if told is not None:
            told = replace(told, sigma=math.hypot(told.sigma, _FOCAL_SHARE * self._focal_sigma))
        if self._remembered is not None:  # which the network has had its part in
            return settled_with_network(told, self._remembered, True)
        return settled_with_network(told, self.network(), depth is not None and depth.in_domain)

    def _with_focal(self, depth: DepthScale) -> LogScale:
        """Map depth, and the network's metres, go with the focal length: its whole uncertainty is the ratio's too."""
        return replace(depth.opinion, sigma=math.hypot(depth.sigma, self._focal_sigma))


def _estimate(known: LogScale) -> ScaleEstimate:
    value = math.exp(known.log_scale)
    return ScaleEstimate(value, value * known.sigma, known.source)
