"""Detection of openings of a door's width in a wall.

Posters, closed doors and window panes are solid in depth and leave no opening. False openings are rejected by two more
conditions: collinear walls on both sides, and space that widens in front and behind (two cupboards facing each other
across a corridor fail). Free space is carved only up to depth less two standard deviations, so a door beside the path,
seen at a grazing angle in a few frames, stays mostly unknown: such an opening is detected, too, but leads nowhere yet.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.openings.wall_frame import WallGrid, runs
from edgeslam_torch.types import FloatArray

NARROWEST_M, WIDEST_M = 0.6, 1.5
"""Width of an exit: passable for a drone, at most a door (a wing of a double door has 1.2 m)."""
_JAMB_M, _WALL_SHARE = 0.2, 0.7
"""Collinear wall: minimum length at each side [m], and of both sides together as a share of the opening's width.
Furniture along a corridor fails."""
_ALONGSIDE_M = 1.2
"""Distance to each side within which wall counts."""
_BEYOND_M = (0.25, 0.65)
"""Band in front of and behind the wall that must be free, beyond the depth of a door frame."""
_BESIDE_M = 0.2
"""Distance beside the opening's ends within which the space must widen; a door may be this close to a corner."""
_WIDER_M = 0.3
"""Minimum widening of the space on either side; walls that bulge by a cell or two make no door of a corridor."""
_FREE_SHARE, _SOLID_SHARE = 0.8, 0.3
_ROOM_SHARE = 0.5
"""Minimum share of free cells in front of an opening that leads nowhere yet."""
_PARTLY_FREE = 0.3
"""Minimum share of free cells in any opening."""
_AROUND_M = 2.0
"""Radius of the search: detours around furniture are shorter, two doors of one room are farther apart."""
_SEAL_M, _ENDS_M = 0.15, 0.2
"""Half depth of the virtual plug in the opening, and its overlap beyond the ends."""
SAME_M = 0.5
"""Openings closer than this are the same."""


@dataclass(frozen=True, slots=True)
class Gap:
    """An opening detected in one grid."""

    centre_w: FloatArray
    """``(2,)`` [m]."""
    normal_w: FloatArray
    """``(2,)`` unit normal, pointing away from the viewpoint."""
    width_m: float
    wall_m: float
    """Length of collinear wall at both sides together, a measure of confidence [m]."""
    leads: bool
    """Whether space is known on both sides; depth smears frames into their doors, so some cells may not be free."""
    is_free: bool
    """Whether it leads on and all of its cells are free."""


def openings(grids: list[WallGrid]) -> list[Gap]:
    """Openings in walls, from grids of `along_walls`, the most confident first."""
    found = [_gap(grid, t, *ends) for grid in grids for t, *ends in _jambs(grid)]
    return _distinct([gap for gap in found if gap is not None])


def _jambs(grid: WallGrid) -> Iterator[tuple[int, int, int]]:
    """Gaps between wall segments: row, last cell of the one segment, first cell of the other."""
    least = _WALL_SHARE * NARROWEST_M / grid.cell_m
    for t in np.flatnonzero(grid.wall[2:-2].sum(1) >= least) + 2:
        parts = [part for part in runs(grid.wall[t]) if (part[1] - part[0]) * grid.cell_m >= _JAMB_M - 1e-9]
        for (_, low), (high, _) in zip(parts[:-1], parts[1:], strict=True):
            if NARROWEST_M <= (high - low + 1) * grid.cell_m <= WIDEST_M + grid.cell_m:
                yield int(t), int(low), int(high)


def _band(grid: WallGrid, t: int, side: int) -> np.ndarray:
    """Rows of the band `_BEYOND_M` on one side of the wall."""
    near, far = (round(x / grid.cell_m) for x in _BEYOND_M)
    rows = t + side * np.arange(near, far + 1)
    return np.asarray(rows[(rows >= 0) & (rows < len(grid.free))])


def _alongside_m(grid: WallGrid, t: int, low: int, high: int) -> float:
    """Length of wall at both sides of an opening together [m]."""
    reach, wall = round(_ALONGSIDE_M / grid.cell_m), grid.wall[t]
    return float(grid.cell_m * (wall[max(0, low - reach) : low].sum() + wall[high : high + reach].sum()))


def _gap(grid: WallGrid, t: int, low: int, high: int) -> Gap | None:
    """The opening between two cells of a row, centred in the thickness of the wall, if it passes all tests."""
    inside = np.s_[t - 1 : t + 2, low + 1 : high - 1]  # without its end cells, which may be unknown
    width, wall_m = (high - low + 1) * grid.cell_m, _alongside_m(grid, t, low, high)
    if grid.free[inside].mean() < _PARTLY_FREE or wall_m < _WALL_SHARE * width:
        return None
    leads = _in_a_wall(grid, t, low, high) and all(
        _before(grid, t, low, high, side) >= _FREE_SHARE and _widens(grid, t, low, high, side) for side in (-1, 1)
    )
    near = -1 if t > 0.5 * (len(grid.free) - 1) else 1
    closed = grid.solid[inside].any(0).mean() > _SOLID_SHARE
    if not leads and (closed or _before(grid, t, low, high, near) < _ROOM_SHARE):
        return None
    # Partly covered end cells are occupied: half of each is open.
    rows = np.arange(t - 1, t + 2)
    beside = grid.upright[rows, max(0, low - 2) : low].any(1) | grid.upright[rows, high : high + 2].any(1)
    centre = grid.at(0.5 * (low + high - 1), float(rows[beside].mean()) if beside.any() else float(t))
    away = float((centre - grid.centre_w) @ grid.left_w)
    normal = grid.left_w * (1.0 if away >= 0 else -1.0)
    return Gap(centre, normal, width, wall_m, leads, leads and bool(grid.free[inside].all()))


def _before(grid: WallGrid, t: int, low: int, high: int, side: int) -> float:
    """Share of free cells on one side of the wall."""
    fifth = (high - low) // 5
    cells = grid.free[_band(grid, t, side), low + fifth : high - fifth]
    return float(cells.mean()) if cells.size else 0.0


def _widens(grid: WallGrid, t: int, low: int, high: int, side: int) -> bool:
    """Whether the non-occupied space on one side is wider than the opening."""
    middle = (low + high) // 2
    widths = []
    for row in grid.solid[_band(grid, t, side)]:
        left, right = np.flatnonzero(row[: middle + 1]), np.flatnonzero(row[middle:])
        ends = left[-1] if len(left) else -1, middle + right[0] if len(right) else len(row)
        widths.append(ends[1] - ends[0] - 1)
    return len(widths) > 0 and (float(np.median(widths)) - (high - low)) * grid.cell_m >= _WIDER_M - 1e-9


def _in_a_wall(grid: WallGrid, t: int, low: int, high: int) -> bool:
    """Whether the space widens beside the opening's ends.

    An open door leaf closes one of four corners; two cupboards close both of a side, a crossing wall both of an end.
    """
    width = round(_BESIDE_M / grid.cell_m)
    ends = slice(max(0, low - width), low), slice(high, high + width)
    closed = np.array(
        [[grid.solid[_band(grid, t, side), end].mean() >= _SOLID_SHARE for end in ends] for side in (-1, 1)]
    )
    return not (closed.all(axis=0).any() or closed.all(axis=1).any())


def _distinct(found: list[Gap]) -> list[Gap]:
    """Non-maximum suppression: what leads on first, then by the length of collinear wall."""
    kept: list[Gap] = []
    for gap in sorted(found, key=lambda g: (not g.is_free, not g.leads, -g.wall_m)):
        if all(np.linalg.norm(gap.centre_w - other.centre_w) > SAME_M for other in kept):
            kept.append(gap)
    return kept


def has_detour(layer: Layer, centre_w: FloatArray, normal_w: FloatArray, width_m: float) -> bool:
    """Whether known free space joins both sides within `_AROUND_M` when the opening is closed.

    Args:
        layer: Layer at the flight height.
        centre_w: ``(2,)`` centre of the opening [m].
        normal_w: ``(2,)`` unit normal.
        width_m: Width of the opening.
    """
    low, high = (layer.cells(centre_w + side * _AROUND_M) for side in (-1.0, 1.0))
    rows, columns = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True)), indexing="ij")
    step = layer.centres(np.stack([rows, columns], axis=-1)) - centre_w
    across, along = step @ normal_w, np.abs(step @ np.array([-normal_w[1], normal_w[0]]))
    closed = (np.abs(across) < _SEAL_M) & (along < 0.5 * width_m + _ENDS_M)
    near = np.linalg.norm(step, axis=-1) < _AROUND_M
    open_ = (layer.clearance_m[rows, columns] >= layer.cell_m) & near & ~closed
    _, parts = cv2.connectedComponents(open_.astype(np.uint8), connectivity=4)
    facing = open_ & (along < 0.25 * width_m) & (np.abs(across) > _BEYOND_M[0]) & (np.abs(across) < _BEYOND_M[1])
    before, behind = (np.unique(parts[facing & (side * across > 0.0)]) for side in (-1.0, 1.0))
    return bool(np.intersect1d(before, behind).size)
