"""Sensor model of depth at an opening: whether the rays of a view pass it."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.types import FloatArray

_BEYOND_M = 0.4
"""Minimum depth behind the wall, beyond frames and niches."""
_MIDDLE = 0.6
"""Central share of the opening's width in which rays count; depth smears the jambs into the rest."""
_MIN_RAYS, _THROUGH_SHARE = 6, 0.6
"""Minimum number of horizontal rays through the centre, and share of them that pass beyond the wall."""


@dataclass(frozen=True, slots=True)
class DepthRays:
    """Horizontal rays of a view."""

    origin_w: FloatArray
    """``(2,)``"""
    step_w: FloatArray
    """``(R, 2)`` along each ray, for a metre of z-depth."""
    depth_m: FloatArray
    """``(R,)``"""

    @staticmethod
    def of(view: View) -> "DepthRays":
        """One ray per image column where it lies in the image."""
        K, R = view.K, view.T_w_c[:3, :3]
        u = np.arange(view.depth_m.shape[1])
        x = (u - K[0, 2]) / K[0, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # it may look straight down
            y = -(R[2, 0] * x + R[2, 2]) / R[2, 1]  # level: no part of the ray is upwards
            v = np.round(K[1, 2] + K[1, 1] * y)
        seen = (v >= 0) & (v < len(view.depth_m))
        depth = np.where(seen, view.depth_m[np.where(seen, v, 0).astype(int), u], np.nan)
        good = depth > 0
        step = np.stack([x, y, np.ones(len(u))], axis=1)[good] @ R.T
        return DepthRays(view.T_w_c[:2, 3], step[:, :2], np.asarray(depth[good], dtype=np.float64))

    def pass_(self, centre_w: FloatArray, normal_w: FloatArray, width_m: float) -> bool:
        """Whether most of the rays through the middle of an opening end beyond the wall; normals point away."""
        to_wall = float((centre_w - self.origin_w) @ normal_w)
        towards = self.step_w @ normal_w
        along = np.array([-normal_w[1], normal_w[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            met_m = to_wall / towards
            aside = np.abs((self.origin_w - centre_w) @ along + met_m * (self.step_w @ along))
        meets = (to_wall > 0) & (towards > 0) & (aside < 0.5 * _MIDDLE * width_m)
        through = meets & (self.depth_m * towards > to_wall + _BEYOND_M)
        return bool(meets.sum() >= _MIN_RAYS and through.sum() >= _THROUGH_SHARE * meets.sum())
