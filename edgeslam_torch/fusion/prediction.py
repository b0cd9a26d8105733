"""Where the camera is at a stamp for which no image has been looked at: by visual velocity, and by telemetry."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.rotations import rotation_vector
from edgeslam_torch.fusion.telemetry_scale import TelemetryFit
from edgeslam_torch.fusion.track import TelemetryTrack
from edgeslam_torch.fusion.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, ScaleEstimate

VISUAL_REACH_S = 0.15
"""The last visual velocity predicts better than 10 Hz readings of 0.1 m/s up to about here."""
_VISUAL_LIMIT_S = 0.5
"""Without telemetry, the camera is held where constant velocity puts it after this time."""
_PACKET_S = 0.15
"""Telemetry runs ahead of a late video; one packet of extrapolation is allowed."""


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
    """``visual``, ``telemetry`` or ``visual+telemetry``."""


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
class Carried:
    """What telemetry needs to carry a pose on."""

    track: TelemetryTrack
    delay_s: float
    T_b_c: FloatArray
    """Camera in the body ``(4, 4)`` [m]."""
    R_w_m: FloatArray | None
    """Map axes to the power-on world ``(3, 3)``."""
    scale: ScaleEstimate
    fit: TelemetryFit
    sigma_velocity_m_s: float

    def on(self, last: VisualPose, stamp_s: float) -> PoseEstimate | None:
        """Pose at a stamp; turned alone while the scale is unknown, ``None`` where telemetry has a hole."""
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
        scale = self.scale
        if self.R_w_m is None or not math.isfinite(scale.sigma):
            return PoseEstimate(stamp_s, T, math.inf, 0.01 + 0.01 * gap, "telemetry")
        moved = np.diff(self.track.displacement(times, self.fit.shortfall_m_s), axis=0)[0]
        if self.fit.moved is not None:
            moved = moved - self.fit.moved.bias * gap
        moved = moved + (R_w_b[1] - R_w_b[0]) @ self.T_b_c[:3, 3]
        T[:3, 3] = last.T[:3, 3] + self.R_w_m.T @ moved / scale.value
        walk = self.sigma_velocity_m_s * math.sqrt(0.1 * gap) + 0.02 * gap
        sigma_m = math.hypot(walk, float(np.linalg.norm(moved)) * scale.sigma / scale.value)
        sigma_t = last.sigma_t + sigma_m / scale.value
        return PoseEstimate(stamp_s, T, sigma_t, math.radians(0.5) + 0.002 * gap, "telemetry")


def between(visual: PoseEstimate, telemetry: PoseEstimate, share: float) -> PoseEstimate:
    """From the one (share 0) to the other (share 1)."""
    if share >= 1.0:
        return telemetry
    T = se3.exp(share * se3.log(telemetry.T_w_c @ se3.inverse(visual.T_w_c))) @ visual.T_w_c
    sigma_t = (1 - share) * visual.sigma_t + share * telemetry.sigma_t
    sigma_r = (1 - share) * visual.sigma_r_rad + share * telemetry.sigma_r_rad
    return PoseEstimate(telemetry.stamp_s, T, sigma_t, sigma_r, "visual+telemetry")
