"""Prediction of the camera pose without an image: by visual velocity, by the Kalman filter, by telemetry alone.

Consecutive frames give a better velocity than telemetry in whole dm/s and degrees, for up to a fifth of a second. The
filter's prediction and that of constant velocity are therefore averaged by their variances: the filter's covariance,
and the unknown acceleration.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.filter.filter_feed import FilterView
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.estimation.telemetry_scale import TelemetryFit
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.noise import ACCELERATION_M_S2, ANGULAR_ACCELERATION_RAD_S2, DELAY_S, VELOCITY_M_S
from edgeslam_torch.types import FloatArray, ScaleEstimate

VISUAL_REACH_S = 0.15
"""Time up to which the last visual velocity predicts better than 10 Hz readings of 0.1 m/s."""
_VISUAL_LIMIT_S = 0.5
"""Time after which constant velocity stops, without telemetry."""
_PACKET_S = 0.15
"""Maximum extrapolation of telemetry, which is ahead of a late video: one packet."""


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
    """``visual``, ``telemetry`` (readings alone), ``visual+telemetry``, or ``filter``."""


def by_filter(view: FilterView, scale: ScaleEstimate, delay_sigma_s: float) -> PoseEstimate:
    """The filter's prediction in the map's units."""
    T = view.T_seen_c.copy()
    T[:3, 3] /= scale.value
    way = float(np.linalg.norm(view.T_seen_c[:3, 3])) * scale.sigma / scale.value
    late = float(np.linalg.norm(view.velocity_m_s)) * delay_sigma_s
    variance = np.diag(view.covariance)
    sigma_m = math.sqrt(float(variance[:3].mean()) + (way**2 + late**2) / 3.0)
    sigma_r = math.sqrt(float(variance[3:6].mean()))
    return PoseEstimate(view.to_s, view.seen.T @ T, sigma_m / scale.value, sigma_r, "filter")


def with_velocity(
    prior: PoseEstimate, last: VisualPose, previous: VisualPose | None, scale: ScaleEstimate
) -> PoseEstimate:
    """The filter's prediction and that of constant velocity, weighted by their variances."""
    if previous is None:
        return prior
    seen = by_vision(last, previous, prior.stamp_s)
    gap, before = prior.stamp_s - last.stamp_s, last.stamp_s - previous.stamp_s
    grown = math.sqrt(1.0 + 2.0 * (gap / before) ** 2)  # jitter of two poses in their difference
    sigma_t = math.hypot(0.5 * ACCELERATION_M_S2 * gap**2 / scale.value, grown * last.sigma_t)
    sigma_r = math.hypot(0.5 * ANGULAR_ACCELERATION_RAD_S2 * gap**2, grown * last.sigma_r_rad)
    share_t, share_r = (b**2 / (a**2 + b**2) for a, b in ((prior.sigma_t, sigma_t), (prior.sigma_r_rad, sigma_r)))
    T = seen.T_w_c.copy()
    T[:3, 3] += share_t * (prior.T_w_c[:3, 3] - T[:3, 3])
    apart = rotation_vector(T[:3, :3].T @ prior.T_w_c[:3, :3])
    T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), share_r * apart]))[:3, :3]
    return replace(
        prior, T_w_c=T, sigma_t=math.sqrt(share_t) * prior.sigma_t, sigma_r_rad=math.sqrt(share_r) * prior.sigma_r_rad
    )


def by_vision(last: VisualPose, previous: VisualPose | None, stamp_s: float) -> PoseEstimate:
    """At constant velocity from the last two tracked frames."""
    gap = stamp_s - last.stamp_s
    T = last.T.copy()
    speed = turn = 0.0
    if previous is not None:
        reach = min(gap, _VISUAL_LIMIT_S) / (last.stamp_s - previous.stamp_s)
        v = (last.T[:3, 3] - previous.T[:3, 3]) * reach
        increment = rotation_vector(previous.T[:3, :3].T @ last.T[:3, :3]) * reach
        T[:3, 3] += v
        T[:3, :3] = T[:3, :3] @ se3.exp(np.concatenate([np.zeros(3), increment]))[:3, :3]
        speed, turn = float(np.linalg.norm(v)), float(np.linalg.norm(increment))
    growth = max(0.0, gap) / VISUAL_REACH_S
    sigma_t = last.sigma_t + growth * max(speed, last.sigma_t)
    return PoseEstimate(last.stamp_s + gap, T, sigma_t, last.sigma_r_rad + growth * max(turn, 0.005), "visual")


@dataclass(frozen=True, slots=True)
class TelemetryPropagation:
    """Inputs for propagating a pose by telemetry."""

    track: TelemetryTrack
    delay_s: float
    delay_sigma_s: float
    """Infinite while the delay is unknown."""
    T_b_c: FloatArray
    """Camera in the body ``(4, 4)`` [m]."""
    R_w_m: FloatArray | None
    """Map axes to the power-on world ``(3, 3)``."""
    scale: ScaleEstimate
    fit: TelemetryFit

    def on(self, last: VisualPose, stamp_s: float) -> PoseEstimate | None:
        """Pose at a stamp; rotation only while the scale is unknown, ``None`` in a gap of telemetry."""
        if len(self.track) < 2:
            return None
        times = np.array([last.stamp_s, stamp_s]) - self.delay_s
        ahead = times[1] > self.track.last_s + _PACKET_S
        if ahead or not self.track.covered(times[:1], times[1:] - 0.3)[0]:
            return None
        R_w_b = self.track.attitude(times)
        R_c_b = self.T_b_c[:3, :3].T
        T = last.T.copy()
        T[:3, :3] = last.T[:3, :3] @ R_c_b @ R_w_b[0].T @ R_w_b[1] @ R_c_b.T
        gap = float(times[1] - times[0])
        scale, late_rad = self.scale, self._late_rad(times)
        if self.R_w_m is None or not math.isfinite(scale.sigma):
            return PoseEstimate(stamp_s, T, math.inf, math.hypot(0.01 + 0.01 * gap, late_rad), "telemetry")
        moved = np.diff(self.track.displacement(times, self.fit.shortfall_m_s), axis=0)[0]
        moved = moved + (R_w_b[1] - R_w_b[0]) @ self.T_b_c[:3, 3]
        T[:3, 3] = last.T[:3, 3] + self.R_w_m.T @ moved / scale.value
        walk = VELOCITY_M_S * math.sqrt(0.1 * gap) + 0.02 * gap
        sigma_m = math.hypot(walk, float(np.linalg.norm(moved)) * scale.sigma / scale.value)
        sigma_t = last.sigma_t + sigma_m / scale.value
        sigma_r_rad = math.hypot(math.radians(0.5) + 0.002 * gap, late_rad)
        return PoseEstimate(stamp_s, T, sigma_t, sigma_r_rad, "telemetry")

    def _late_rad(self, times: FloatArray) -> float:
        """Maximum error of a rotation between two moments due to the uncertain delay."""
        late_s = min(self.delay_sigma_s, DELAY_S)
        R_w_b = [self.track.attitude(times + by_s) for by_s in (0.0, -late_s, late_s)]
        turned = [R[0].T @ R[1] for R in R_w_b]
        return max(float(np.linalg.norm(rotation_vector(turned[0].T @ other))) for other in turned[1:])


def between(visual: PoseEstimate, telemetry: PoseEstimate, share: float) -> PoseEstimate:
    """Interpolation from the one (share 0) to the other (share 1)."""
    if share >= 1.0:
        return telemetry
    T = se3.exp(share * se3.log(telemetry.T_w_c @ se3.inverse(visual.T_w_c))) @ visual.T_w_c
    sigma_t = (1 - share) * visual.sigma_t + share * telemetry.sigma_t
    sigma_r = (1 - share) * visual.sigma_r_rad + share * telemetry.sigma_r_rad
    return PoseEstimate(telemetry.stamp_s, T, sigma_t, sigma_r, "visual+telemetry")
