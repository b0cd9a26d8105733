"""Prediction of the camera pose without an image: by visual velocity and by the Kalman filter.

Consecutive frames give a better velocity than telemetry in whole dm/s and degrees, for up to a fifth of a second. The
filter's prediction and that of constant velocity are therefore averaged by their variances: the filter's covariance,
and the unknown acceleration.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.filter.filter_feed import FilterView
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.noise import ACCELERATION_M_S2, ANGULAR_ACCELERATION_RAD_S2
from edgeslam_torch.types import FloatArray, ScaleEstimate

_VISUAL_REACH_S = 0.15
"""Time up to which the last visual velocity predicts better than 10 Hz readings of 0.1 m/s."""
_VISUAL_LIMIT_S = 0.5
"""Time after which constant velocity stops, without telemetry."""


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
    """``visual`` or ``filter``."""


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
    growth = max(0.0, gap) / _VISUAL_REACH_S
    sigma_t = last.sigma_t + growth * max(speed, last.sigma_t)
    return PoseEstimate(last.stamp_s + gap, T, sigma_t, last.sigma_r_rad + growth * max(turn, 0.005), "visual")
