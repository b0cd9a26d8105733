"""Visual increments in metres for the Kalman filter, at the pace of telemetry."""

import math

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.delay import Delay
from edgeslam_torch.fusion.delayed import BufferedEkf
from edgeslam_torch.fusion.visual_memory import VisualPose
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, ScaleEstimate

_FEED_S = 0.09
"""The filter takes vision at the pace of telemetry: each late increment costs a re-propagation."""
_SURE = 0.1
"""Relative sigma of a scale that makes increments metric."""
_DELAY_STEP_S = 0.1
"""The filter's clock follows the delay in steps: a moving clock would stretch increments."""


class FilterFeed:
    """Keeps the pose at the filter's last visual update."""

    def __init__(self, config: FusionConfig, T_b_c: FloatArray) -> None:
        self.ekf = BufferedEkf(config)
        self._T_b_c = T_b_c
        self._from: VisualPose | None = None
        self._delay_s: float | None = None

    def change(self, visual: VisualPose | None) -> None:
        """The pose at the last update as it is now, in a map that was refined or scaled."""
        self._from = visual

    @property
    def pose(self) -> VisualPose | None:
        """Pose at the last update."""
        return self._from

    def clear(self) -> None:
        """A new map in a new gauge."""
        self._from, self._delay_s = None, None

    def see(self, visual: VisualPose, follows: bool, delay: Delay, scale: ScaleEstimate, measured: bool) -> None:
        """A tracked frame.

        Args:
            visual: Its pose in the map.
            follows: Whether tracking has not been interrupted since the frame before.
            delay: Video delay behind telemetry.
            scale: Metres per map unit.
            measured: Whether the drone's own sensors have a part in that.
        """
        start = self._from
        if not follows or start is None or not math.isfinite(delay.sigma_s):
            self._from = visual
            return
        if visual.stamp_s - start.stamp_s < _FEED_S:
            return
        self._from = visual
        if not scale.sigma < _SURE * scale.value or not measured:
            return
        if self._delay_s is None or abs(self._delay_s - delay.value_s) > _DELAY_STEP_S:
            self._delay_s = delay.value_s
        T_c = se3.inverse(start.T) @ visual.T
        moved = float(np.linalg.norm(T_c[:3, 3])) * scale.value
        T_c[:3, 3] *= scale.value
        T_b = self._T_b_c @ T_c @ se3.inverse(self._T_b_c)
        sigma_t = math.sqrt(2.0) * visual.sigma_t * scale.value
        sigma_t = math.hypot(max(sigma_t, 1e-4), moved * scale.sigma / scale.value)
        sigma_r = max(math.sqrt(2.0) * visual.sigma_r_rad, 1e-4)
        self.ekf.add_relative(start.stamp_s - self._delay_s, visual.stamp_s - self._delay_s, T_b, sigma_t, sigma_r)
