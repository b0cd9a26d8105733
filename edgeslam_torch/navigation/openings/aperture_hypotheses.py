"""Aperture hypotheses: openings through which a single view sees beyond a wall before free space confirms them.

Free space is carved only up to depth less two standard deviations. A door beside the path, seen at a grazing angle in
a few frames, stays mostly unknown: it is worth a look from the front, but no exit yet.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import View
from edgeslam_torch.navigation.openings.exits import PARTLY_FREE, Gap, band, distinct, gap_of, is_in_line, jambs
from edgeslam_torch.navigation.openings.wall_frame import WallGrid
from edgeslam_torch.types import FloatArray

NEAR_M = 4.0
"""Maximum distance; beyond it a door covers a few pixels of uncertain depth."""
_SOLID_SHARE = 0.3
"""Maximum share of the opening's width with occupied cells."""
_BEFORE_SHARE = 0.5
"""Minimum share of free cells in front of the opening."""
_BEYOND_M = 0.4
"""Minimum depth behind the wall, beyond frames and niches."""
_MIDDLE = 0.6
"""Central share of the opening's width in which rays count; depth smears the jambs into the rest."""
_MIN_RAYS, _THROUGH_SHARE = 6, 0.6
"""Minimum number of horizontal rays through the centre, and share of them that pass beyond the wall."""


@dataclass(frozen=True, slots=True)
class _Rays:
    """Horizontal rays of a view."""

    origin_w: FloatArray
    """``(2,)``"""
    step_w: FloatArray
    """``(R, 2)`` along each ray, for a metre of z-depth."""
    depth_m: FloatArray
    """``(R,)``"""


def aperture_hypotheses(grids: list[WallGrid], view: View, here_w: FloatArray) -> list[Gap]:
    """Openings in walls that a view looks through, the most confident first.

    Args:
        grids: What is known around, `along_walls`.
        view: Of this moment.
        here_w: ``(2,)`` where the drone is.
    """
    rays = _level(view)
    near = [gap for grid in grids for gap in _unclosed(grid) if np.linalg.norm(gap.centre_w - here_w) < NEAR_M]
    return distinct([gap for gap in near if _goes_through(rays, gap)])


def _unclosed(grid: WallGrid) -> Iterator[Gap]:
    """Gaps not known to be closed, with free space in front."""
    middle = 0.5 * (len(grid.free) - 1)
    for t, low, high in jambs(grid):
        inside, fifth = np.s_[t - 1 : t + 2, low + 1 : high - 1], (high - low) // 5
        before = grid.free[band(grid, t, -1 if t > middle else 1), low + fifth : high - fifth]
        room = before.size > 0 and before.mean() >= _BEFORE_SHARE
        open_ = grid.free[inside].mean() >= PARTLY_FREE and grid.solid[inside].any(0).mean() <= _SOLID_SHARE
        if room and open_ and is_in_line(grid, t, low, high):
            yield gap_of(grid, t, low, high)


def _level(view: View) -> _Rays:
    """Horizontal rays of a camera, one per image column where it lies in the image."""
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
    """Whether rays through the centre of an opening pass beyond the wall."""
    to_wall = float((gap.centre_w - rays.origin_w) @ gap.normal_w)
    towards = rays.step_w @ gap.normal_w
    along = np.array([-gap.normal_w[1], gap.normal_w[0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        met_m = to_wall / towards
        aside = np.abs((rays.origin_w - gap.centre_w) @ along + met_m * (rays.step_w @ along))
    meets = (to_wall > 0) & (towards > 0) & (aside < 0.5 * _MIDDLE * gap.width_m)
    through = meets & (rays.depth_m * towards > to_wall + _BEYOND_M)
    return bool(meets.sum() >= _MIN_RAYS and through.sum() >= _THROUGH_SHARE * meets.sum())
