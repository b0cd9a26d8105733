"""Glimpses: where one picture shows something behind a wall, though free space has not opened there yet.

Free space is carved as far as depth less two sigmas. Of a door beside a corridor, seen aslant in three pictures, little
more than the jambs is left by that: worth a look from before it, not an exit.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.navigation.openings.exits import PARTLY_FREE, Gap, band, distinct, gap_of, is_in_line, jambs
from edgeslam_torch.navigation.openings.wall_frame import WallGrid
from edgeslam_torch.types import FloatArray

NEAR_M = 4.0
"""Farther away a door is a few pixels of uncertain depth."""
_SOLID_SHARE = 0.3
"""Of the opening's cells some are known to be free; of its width little is known to be closed."""
_BEFORE_SHARE = 0.5
"""Of the cells before it: a place to look from."""
_BEYOND_M = 0.4
"""Depth behind the wall that is no frame and no niche."""
_MIDDLE = 0.6
"""Part of the opening's width through which rays count: its jambs smear into it."""
_MIN_RAYS, _THROUGH_SHARE = 6, 0.6
"""Level rays that meet the middle of it, and how many of them go on."""


@dataclass(frozen=True, slots=True)
class _Rays:
    """Level rays of a view."""

    origin_w: FloatArray
    """``(2,)``"""
    step_w: FloatArray
    """``(R, 2)`` along each ray, for a metre of z-depth."""
    depth_m: FloatArray
    """``(R,)``"""


def aperture_hypotheses(grids: list[WallGrid], view: View, here_w: FloatArray) -> list[Gap]:
    """What may be openings in walls, between what is upright, that a view looks through, the surest first.

    Args:
        grids: What is known around, `along_walls`.
        view: Of this moment.
        here_w: ``(2,)`` where the drone is.
    """
    rays = _level(view)
    near = [gap for grid in grids for gap in _unclosed(grid) if np.linalg.norm(gap.centre_w - here_w) < NEAR_M]
    return distinct([gap for gap in near if _goes_through(rays, gap)])


def _unclosed(grid: WallGrid) -> Iterator[Gap]:
    """Openings that are not known to be closed, with space before them."""
    middle = 0.5 * (len(grid.free) - 1)
    for t, low, high in jambs(grid):
        inside, fifth = np.s_[t - 1 : t + 2, low + 1 : high - 1], (high - low) // 5
        before = grid.free[band(grid, t, -1 if t > middle else 1), low + fifth : high - fifth]
        room = before.size > 0 and before.mean() >= _BEFORE_SHARE
        open_ = grid.free[inside].mean() >= PARTLY_FREE and grid.solid[inside].any(0).mean() <= _SOLID_SHARE
        if room and open_ and is_in_line(grid, t, low, high):
            yield gap_of(grid, t, low, high)


def _level(view: View) -> _Rays:
    """Rays that leave a camera level, one per column where its picture has one."""
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
    return _Rays(view.T_w_c[:2, 3], step[:, :2], np.asarray(depth[good], dtype=np.float64))


def _goes_through(rays: _Rays, gap: Gap) -> bool:
    """Whether what meets the middle of an opening is seen to go on behind it."""
    to_wall = float((gap.centre_w - rays.origin_w) @ gap.normal_w)
    towards = rays.step_w @ gap.normal_w
    along = np.array([-gap.normal_w[1], gap.normal_w[0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        met_m = to_wall / towards
        aside = np.abs((rays.origin_w - gap.centre_w) @ along + met_m * (rays.step_w @ along))
    meets = (to_wall > 0) & (towards > 0) & (aside < 0.5 * _MIDDLE * gap.width_m)
    through = meets & (rays.depth_m * towards > to_wall + _BEYOND_M)
    return bool(meets.sum() >= _MIN_RAYS and through.sum() >= _THROUGH_SHARE * meets.sum())
