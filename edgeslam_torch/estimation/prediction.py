"""Prediction of the camera pose without an image: by the Kalman filter, or at constant velocity without it."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.filter.filter_feed import FilterView
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import rotation_vector
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
    sigma_m, sigma_r, _ = np.sqrt(np.diag(view.with_doubts(scale, delay_sigma_s)).reshape(3, 3).mean(axis=1)).tolist()
    return PoseEstimate(view.to_s, view.seen.T @ T, sigma_m / scale.value, sigma_r, "filter")


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
