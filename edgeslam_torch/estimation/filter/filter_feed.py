"""Feeds tracked poses to the Kalman filter as metric increments, and expresses its predictions in the map.

The filter estimates only the motion of the body since the last visual pose, not the pose of the map in the drone's
world. This suffices for predictions in the map, and stays valid when the map is moved, rotated or scaled.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.config import MAX_GAP_S, FusionConfig
from edgeslam_torch.estimation.filter.delayed import BufferedEkf, PoseSigma
from edgeslam_torch.estimation.telemetry.delay import Delay
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, rotation_vector
from edgeslam_torch.noise import VISUAL_DRIFT, VISUAL_DRIFT_TURN, VISUAL_JITTER_M, VISUAL_JITTER_RAD
from edgeslam_torch.types import FloatArray, ScaleEstimate, TelemetrySample

_SAME_S = 1e-6
_SURE = 0.2
"""Maximum relative sigma of the scale: over a video's delay, 0.2 m of flight at most, that is an error of 4 cm."""
_DELAY_MOVED_S = 0.003
"""Change of the estimated delay after which increments restart: one across it would cover a wrong interval."""


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """Predicted camera pose in the map's own gauge."""

    T_w_c: FloatArray
    """``(4, 4)``, map units."""
    sigma_t: float
    """Standard deviation of the translation per axis [map units]."""
    sigma_r_rad: float


@dataclass(frozen=True, slots=True)
class FilterView:
    """The filter's estimate at one stamp, relative to a visual pose of the map."""

    seen: VisualPose
    """The last visual pose of the camera."""
    to_s: float
    """Stamp of the estimate, on the clock of the requested one."""
    T_seen_c: FloatArray
    """``(4, 4)`` camera, relative to the camera at `seen` [m]."""
    velocity_m_s: FloatArray
    """``(3,)`` of the body, in the axes of the camera at `seen`."""
    covariance: FloatArray
    """``(9, 9)`` of translation [m], rotation vector [rad] and velocity [m/s], in the axes of the camera at `seen`."""

    def with_doubts(self, scale: ScaleEstimate, delay_sigma_s: float) -> FloatArray:
        """The covariance, with the uncertainty of scale and delay added."""
        covariance = self.covariance.copy()
        way = self.T_seen_c[:3, 3] * (scale.sigma / scale.value)
        late = self.velocity_m_s * delay_sigma_s
        covariance[:3, :3] += np.outer(way, way) + np.outer(late, late)
        return covariance

    def in_map(self, scale: ScaleEstimate, delay_sigma_s: float) -> PoseEstimate:
        """The estimate in the map's units."""
        T = self.T_seen_c.copy()
        T[:3, 3] /= scale.value
        sigma = np.sqrt(np.diag(self.with_doubts(scale, delay_sigma_s)).reshape(3, 3).mean(axis=1)).tolist()
        return PoseEstimate(self.seen.T @ T, sigma[0] / scale.value, sigma[1])


class FilterFeed:
    """Converts visual poses to filter updates, relative to the pose at the last update."""

    def __init__(self, config: FusionConfig, T_b_c: FloatArray) -> None:
        self._config, self._T_b_c = config, T_b_c
        self.ekf = BufferedEkf(config)
        self._seen: VisualPose | None = None
        self._delay: Delay | None = None
        """Delay by which the stamp of that pose was converted to telemetry's clock."""
        self._accumulated: FloatArray | None = None
        """Visual odometry accumulated by the paper's filter: body in the power-on world [m]."""

    @property
    def seen(self) -> VisualPose | None:
        """Pose at the last update."""
        return self._seen

    def move_map(self, seen: VisualPose | None) -> None:
        """Replace the pose at the last update after the map was refined, moved or scaled."""
        self._seen = seen

    def clear(self) -> None:
        """Reset the last pose: a new map has another gauge."""
        self._seen = self._delay = self._accumulated = None

    def add_telemetry(self, sample: TelemetrySample, shortfall_m_s: float, climb_m_s: float = math.nan) -> None:
        """Add one state message.

        Args:
            sample: The message.
            shortfall_m_s: Mean truncation loss of its non-zero velocities.
            climb_m_s: Vertical velocity by heights, which counts instead of the reported one: whole decimetres a second
                lose half a metre of height in ten seconds.
        """
        corrected = _corrected(sample, shortfall_m_s)
        ranged = math.isfinite(climb_m_s)
        if ranged:
            corrected = replace(corrected, velocity_m_s=np.append(corrected.velocity_m_s[:2], climb_m_s))
        self.ekf.add_telemetry(corrected, ranged)

    def see(self, visual: VisualPose, scale: ScaleEstimate, delay: Delay) -> None:
        """Update the filter with a tracked frame, at metres per map unit and the video's delay behind telemetry."""
        seen = self._seen
        if not (scale.sigma < _SURE * scale.value and math.isfinite(delay.sigma_s)):
            self._seen = None
            return
        moved_clock = self._delay is None or abs(self._delay.value_s - delay.value_s) > _DELAY_MOVED_S
        if moved_clock or self._delay is None:
            self._delay = delay
        stamp_s = visual.stamp_s - self._delay.value_s
        self._seen = visual
        if seen is None or moved_clock:
            self._accumulated = None
            self.ekf.see(stamp_s)
            return
        T_c = se3.inverse(seen.T) @ visual.T
        T_c[:3, 3] *= scale.value
        T_b = self._T_b_c @ T_c @ se3.inverse(self._T_b_c)
        jitter = PoseSigma(
            math.hypot(visual.sigma_t * scale.value, VISUAL_JITTER_M), math.hypot(visual.sigma_r_rad, VISUAL_JITTER_RAD)
        )
        from_s = seen.stamp_s - self._delay.value_s
        if self._config.literal:
            self._add_accumulated(from_s, stamp_s, T_b, jitter)
            return
        share = math.hypot(VISUAL_DRIFT, scale.sigma / scale.value)
        turned = float(np.linalg.norm(rotation_vector(T_c[:3, :3])))
        drift = PoseSigma(share * float(np.linalg.norm(T_c[:3, 3])), VISUAL_DRIFT_TURN * turned)
        self.ekf.add_relative(from_s, stamp_s, T_b, drift, jitter)

    def _add_accumulated(self, from_s: float, to_s: float, T_b: FloatArray, sigma: PoseSigma) -> None:
        """Paper eq. (13): the chained increments are measured as an absolute pose."""
        if self._accumulated is None:
            start = self.ekf.state_at(from_s)
            if start is None:
                return
            self._accumulated = np.eye(4)
            self._accumulated[:3, :3], self._accumulated[:3, 3] = matrix_from_rpy(start.rpy_rad), start.p_w
        self._accumulated = self._accumulated @ T_b
        self.ekf.add_absolute(to_s, self._accumulated, sigma)

    def view(self, stamp_s: float) -> FilterView | None:
        """The camera at a frame's stamp; ``None`` before the first update, and where telemetry ends too early."""
        seen, delay = self._seen, self._delay
        if seen is None or delay is None:
            return None
        at_s = stamp_s - delay.value_s
        if not at_s <= self.ekf.telemetry_s + MAX_GAP_S:
            return None
        since = self.ekf.since_visual(at_s)
        if since is None or not abs(since[0] + delay.value_s - seen.stamp_s) < _SAME_S:
            return None
        T_c_b, moved = se3.inverse(self._T_b_c), since[1]
        turn = np.kron(np.eye(3), T_c_b[:3, :3])
        T_seen_c = T_c_b @ moved.T @ self._T_b_c
        return FilterView(seen, stamp_s, T_seen_c, T_c_b[:3, :3] @ moved.velocity_m_s, turn @ moved.covariance @ turn.T)

    def frozen(self) -> "FilterFeed":
        """The filter as it is now, for another thread."""
        other = copy(self)
        other.ekf = self.ekf.resumed()
        return other

    def at_present(self, stamp_s: float, telemetry: Sequence[TelemetrySample] = ()) -> FilterView | None:
        """The camera on telemetry's clock, at ``stamp_s`` or at the filter's newest event if that is later.

        Args:
            stamp_s: Requested time.
            telemetry: State messages that the filter does not have yet; it is not changed.
        """
        if self._delay is None:
            return None
        other = self.frozen()
        for sample in telemetry:
            other.ekf.add_telemetry(sample)
        found = other.view(max(stamp_s, other.ekf.stamp_s or stamp_s) + self._delay.value_s)
        return None if found is None else replace(found, to_s=found.to_s - self._delay.value_s)


def _corrected(sample: TelemetrySample, shortfall_m_s: float) -> TelemetrySample:
    """Correct a truncated velocity by the mean truncation loss."""
    if shortfall_m_s == 0.0:
        return sample
    return replace(sample, velocity_m_s=sample.velocity_m_s + shortfall_m_s * np.sign(sample.velocity_m_s))
