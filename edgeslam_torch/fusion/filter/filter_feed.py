"""The Kalman filter and the visual map: tracked poses go in as metric increments, predicted poses come out.

The filter does not estimate where the map lies in the drone's world, only the body relative to its last visual pose,
which is all that a prediction in the map needs: a map that is moved, rotated or scaled transforms the prediction.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.filter.delayed import BufferedEkf, PoseSigma
from edgeslam_torch.fusion.telemetry.delay import Delay
from edgeslam_torch.fusion.telemetry.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, rotation_vector
from edgeslam_torch.types import FloatArray, ScaleEstimate, TelemetrySample

_SAME_S = 1e-6
_SURE = 0.2
"""Relative sigma of a scale that makes increments metric: over the delay of a video, 0.2 m at most, it costs 4 cm."""
_DELAY_MOVED_S = 0.003
"""The filter's clock follows the delay; where it jumps, increments start anew: they would be stretched."""
_DRIFT = 0.01
"""Share of the way by which a map drifts from one frame to the next."""
_DRIFT_TURN = 0.003
_JITTER_M, _JITTER_RAD = 0.002, 0.001
"""Least jitter of a tracked pose."""


@dataclass(frozen=True, slots=True)
class Metric:
    """What turns the map's units and clock into the drone's."""

    scale: ScaleEstimate
    """Metres per map unit."""
    delay: Delay

    @property
    def sure(self) -> bool:
        """Whether increments may go into the filter."""
        return self.scale.sigma < _SURE * self.scale.value and math.isfinite(self.delay.sigma_s)


@dataclass(frozen=True, slots=True)
class FilterView:
    """The filter's estimate at one stamp, relative to a visual pose of the map."""

    seen: VisualPose
    """The last visual pose of the camera."""
    to_s: float
    """Stamp of the estimate on the frames' clock."""
    T_seen_c: FloatArray
    """``(4, 4)`` camera in the camera that was seen [m]."""
    velocity_m_s: FloatArray
    """``(3,)`` of the body, in the axes of the camera that was seen."""
    covariance: FloatArray
    """``(9, 9)`` of translation [m], rotation vector [rad] and velocity [m/s], in the axes of the camera that was
    seen."""


class FilterFeed:
    """Keeps the pose at the filter's last visual update."""

    def __init__(self, config: FusionConfig, T_b_c: FloatArray) -> None:
        self._config, self._T_b_c = config, T_b_c
        self.ekf = BufferedEkf(config)
        self._seen: VisualPose | None = None
        self._delay: Delay | None = None
        """Of the filter's clock at that pose."""
        self._accumulated: FloatArray | None = None
        """The printed filter's own visual odometry: body in the power-on world [m]."""

    @property
    def seen(self) -> VisualPose | None:
        """Pose at the last update."""
        return self._seen

    def move_map(self, seen: VisualPose | None) -> None:
        """The pose at the last update as it is now, in a map that was refined or scaled."""
        self._seen = seen

    def clear(self) -> None:
        """A new map in a new gauge."""
        self._seen = self._delay = self._accumulated = None

    def add_telemetry(self, sample: TelemetrySample, shortfall_m_s: float) -> None:
        """One state message; its velocity reads low by ``shortfall_m_s`` unless it is zero."""
        self.ekf.add_telemetry(_made_up(sample, shortfall_m_s))

    def see(self, visual: VisualPose, metric: Metric) -> None:
        """A tracked frame."""
        seen = self._seen
        if not metric.sure:
            self._seen = None
            return
        moved_clock = self._delay is None or abs(self._delay.value_s - metric.delay.value_s) > _DELAY_MOVED_S
        if moved_clock or self._delay is None:
            self._delay = metric.delay
        stamp_s = visual.stamp_s - self._delay.value_s
        self._seen = visual
        if seen is None or moved_clock:
            self._accumulated = None
            self.ekf.see(stamp_s)
            return
        scale = metric.scale
        T_c = se3.inverse(seen.T) @ visual.T
        T_c[:3, 3] *= scale.value
        T_b = self._T_b_c @ T_c @ se3.inverse(self._T_b_c)
        jitter = PoseSigma(
            math.hypot(visual.sigma_t * scale.value, _JITTER_M), math.hypot(visual.sigma_r_rad, _JITTER_RAD)
        )
        from_s = seen.stamp_s - self._delay.value_s
        if self._config.literal:
            self._add_accumulated(from_s, stamp_s, T_b, jitter)
            return
        share = math.hypot(_DRIFT, scale.sigma / scale.value)
        turned = float(np.linalg.norm(rotation_vector(T_c[:3, :3])))
        drift = PoseSigma(share * float(np.linalg.norm(T_c[:3, 3])), _DRIFT_TURN * turned)
        self.ekf.add_relative(from_s, stamp_s, T_b, drift, jitter)

    def _add_accumulated(self, from_s: float, to_s: float, T_b: FloatArray, sigma: PoseSigma) -> None:
        """Paper eq. (13): increments one after the other are taken for a pose."""
        if self._accumulated is None:
            start = self.ekf.state_at(from_s)
            if start is None:
                return
            self._accumulated = np.eye(4)
            self._accumulated[:3, :3], self._accumulated[:3, 3] = matrix_from_rpy(start.rpy_rad), start.p_w
        self._accumulated = self._accumulated @ T_b
        self.ekf.add_absolute(to_s, self._accumulated, sigma)

    def view(self, stamp_s: float) -> FilterView | None:
        """Where the filter has the camera at a frame's stamp; ``None`` where it does not know.

        That is before it was fed, and where telemetry ends too early.
        """
        return view(self.ekf, self._seen, self._delay, stamp_s, self._T_b_c, self._config.max_gap_s)

    def frozen(self) -> "FrozenFilter | None":
        """The filter as it is now, for another thread."""
        if self._seen is None or self._delay is None:
            return None
        return FrozenFilter(self.ekf.resumed(), self._seen, self._delay, self._T_b_c, self._config.max_gap_s)


@dataclass(frozen=True, slots=True)
class FrozenFilter:
    """An immutable copy of the filter."""

    ekf: BufferedEkf
    seen: VisualPose
    delay: Delay
    T_b_c: FloatArray
    max_gap_s: float

    def view(self, stamp_s: float, telemetry: Sequence[TelemetrySample] = ()) -> FilterView | None:
        """Where the camera is at a moment of telemetry's clock, or at the filter's own if that is later.

        Args:
            stamp_s: When.
            telemetry: What has arrived since.
        """
        ekf = self.ekf.resumed()
        for sample in telemetry:
            ekf.add_telemetry(sample)
        at_s = max(stamp_s, ekf.stamp_s or stamp_s) + self.delay.value_s
        return view(ekf, self.seen, self.delay, at_s, self.T_b_c, self.max_gap_s)


def view(
    ekf: BufferedEkf, seen: VisualPose | None, delay: Delay | None, stamp_s: float, T_b_c: FloatArray, max_gap_s: float
) -> FilterView | None:
    """The filter's opinion at a frame's stamp; ``None`` where telemetry ends more than ``max_gap_s`` before."""
    if seen is None or delay is None:
        return None
    at_s = stamp_s - delay.value_s
    if not at_s <= ekf.telemetry_s + max_gap_s:
        return None
    moved = ekf.since_visual(at_s)
    if moved is None or not abs(moved.from_s + delay.value_s - seen.stamp_s) < _SAME_S:
        return None
    T_c_b = se3.inverse(T_b_c)
    turn = np.kron(np.eye(3), T_c_b[:3, :3])
    return FilterView(
        seen,
        stamp_s,
        T_c_b @ moved.relative.T @ T_b_c,
        T_c_b[:3, :3] @ moved.relative.velocity_m_s,
        turn @ moved.relative.covariance @ turn.T,
    )


def _made_up(sample: TelemetrySample, shortfall_m_s: float) -> TelemetrySample:
    """A truncated velocity put back to where it lies on average."""
    if shortfall_m_s == 0.0:
        return sample
    return replace(sample, velocity_m_s=sample.velocity_m_s + shortfall_m_s * np.sign(sample.velocity_m_s))
