"""Exits: openings of a door's width in a wall, with free space on both sides.

A poster, a closed door and a window's pane are solid to depth, so they leave no opening. What depth takes for an
opening and is none must also have a wall to both sides in one line, and space that widens before and behind it: two
cupboards that face each other across a corridor have not.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.openings.wall_frame import WallGrid, runs
from edgeslam_torch.types import FloatArray

NARROWEST_M, WIDEST_M = 0.6, 1.5
"""Width of an exit: a drone passes, a door is no wider (a wing of a double door is 1.2 m)."""
_JAMB_M, _WALL_SHARE = 0.2, 0.7
"""Wall in line with the opening: metres at each side at least, and share of the opening's width at both sides together.
Things that stand along a corridor narrow it; they do not make a wall of it."""
_ALONGSIDE_M = 1.2
"""How far to each side wall counts."""
_BEYOND_M = (0.25, 0.65)
"""Band before and behind the wall in which there must be space: from a frame's depth to where a drone stands."""
_BESIDE_M = 0.2
"""How far beside the opening's ends the space must widen: a door may be this near to a corner."""
_WIDER_M = 0.3
"""How much wider than the opening the space is on either side at least: walls that bulge by a cell or two, or that lie
aslant, make no door of a corridor."""
_FREE_SHARE, _SOLID_SHARE = 0.8, 0.3
PARTLY_FREE = 0.3
"""Share of an opening's cells that are known to be free if it may be one."""
_SAME_M = 0.5
"""Two openings nearer than this are one: no wall between two doors is thinner."""


@dataclass(frozen=True, slots=True)
class Gap:
    """An opening as one look at the grid shows it."""

    centre_w: FloatArray
    """``(2,)`` [m]."""
    normal_w: FloatArray
    """``(2,)`` level unit vector through it, away from the place that was looked from."""
    width_m: float
    wall_m: float
    """Wall in line with it, to both sides together: the more, the surer."""
    is_free: bool
    """Whether all of it is known to be."""


def openings(grids: list[WallGrid]) -> list[Gap]:
    """What leads through a wall around a place, by what is there `along_walls`, once for every row of the wall.

    Also what is known to be free in a part alone, though there is space on both sides: frames smear into their doors.
    """
    found = [_gap(grid, t, *ends) for grid in grids for t, *ends in jambs(grid)]
    return [gap for gap in found if gap is not None]


def jambs(grid: WallGrid) -> Iterator[tuple[int, int, int]]:
    """What may be an exit between two parts of a wall: its row, with the rows beside it, the last cell of the one part
    and the first of the other."""
    least = _WALL_SHARE * NARROWEST_M / grid.cell_m
    for t in np.flatnonzero(grid.wall[2:-2].sum(1) >= least) + 2:
        parts = [part for part in runs(grid.wall[t]) if (part[1] - part[0]) * grid.cell_m >= _JAMB_M - 1e-9]
        for (_, low), (high, _) in zip(parts[:-1], parts[1:], strict=True):
            if NARROWEST_M <= (high - low + 1) * grid.cell_m <= WIDEST_M + grid.cell_m:
                yield int(t), int(low), int(high)


def is_in_line(grid: WallGrid, t: int, low: int, high: int) -> bool:
    """Whether there is enough wall in line with an opening to call it one in a wall."""
    return _alongside_m(grid, t, low, high) >= _WALL_SHARE * (high - low + 1) * grid.cell_m


def band(grid: WallGrid, t: int, side: int) -> np.ndarray:
    """Rows before or behind the wall, from a frame's depth to where a drone stands."""
    near, far = (round(x / grid.cell_m) for x in _BEYOND_M)
    rows = t + side * np.arange(near, far + 1)
    return np.asarray(rows[(rows >= 0) & (rows < len(grid.free))])


def gap_of(grid: WallGrid, t: int, low: int, high: int) -> Gap:
    """The opening between two cells of a row, in the middle of the wall beside it."""
    width = (high - low + 1) * grid.cell_m  # a cell that a wall only touches is solid: half of each end's is open
    rows = np.arange(t - 1, t + 2)
    beside = grid.upright[rows, max(0, low - 2) : low].any(1) | grid.upright[rows, high : high + 2].any(1)
    centre = grid.at(0.5 * (low + high - 1), float(rows[beside].mean()) if beside.any() else float(t))
    away = float((centre - grid.centre_w) @ grid.left_w)
    normal = grid.left_w * (1.0 if away >= 0 else -1.0)
    return Gap(centre, normal, width, _alongside_m(grid, t, low, high), bool(_inside(grid, t, low, high).all()))


def _alongside_m(grid: WallGrid, t: int, low: int, high: int) -> float:
    """Metres of wall beside an opening, to both sides together."""
    reach, wall = round(_ALONGSIDE_M / grid.cell_m), grid.wall[t]
    return float(grid.cell_m * (wall[max(0, low - reach) : low].sum() + wall[high : high + reach].sum()))


def _inside(grid: WallGrid, t: int, low: int, high: int) -> np.ndarray:
    """What of an opening is free; a cell at each end may have been seen too little to be known."""
    return grid.free[t - 1 : t + 2, low + 1 : high - 1]


def _gap(grid: WallGrid, t: int, low: int, high: int) -> Gap | None:
    """The opening between two cells of a row, if it leads from somewhere to somewhere."""
    if _inside(grid, t, low, high).mean() < PARTLY_FREE:
        return None
    if not all(_leads(grid, t, low, high, side) and _widens(grid, t, low, high, side) for side in (-1, 1)):
        return None
    if not (_in_a_wall(grid, t, low, high) and is_in_line(grid, t, low, high)):
        return None
    return gap_of(grid, t, low, high)


def _leads(grid: WallGrid, t: int, low: int, high: int, side: int) -> bool:
    """Whether there is space on one side of the wall."""
    fifth = (high - low) // 5
    before = grid.free[band(grid, t, side), low + fifth : high - fifth]
    return before.size > 0 and float(before.mean()) >= _FREE_SHARE


def _widens(grid: WallGrid, t: int, low: int, high: int, side: int) -> bool:
    """Whether what is not known to be solid is wider on one side than the opening."""
    middle = (low + high) // 2
    widths = []
    for row in grid.solid[band(grid, t, side)]:
        left, right = np.flatnonzero(row[: middle + 1]), np.flatnonzero(row[middle:])
        ends = left[-1] if len(left) else -1, middle + right[0] if len(right) else len(row)
        widths.append(ends[1] - ends[0] - 1)
    return len(widths) > 0 and (float(np.median(widths)) - (high - low)) * grid.cell_m >= _WIDER_M - 1e-9


def _in_a_wall(grid: WallGrid, t: int, low: int, high: int) -> bool:
    """Whether the space widens on each side of the wall, and each end stands free of what leads away from it.

    A leaf that stands open closes one corner. Two cupboards close both of a side, a wall that crosses both of an end.
    """
    width = round(_BESIDE_M / grid.cell_m)
    ends = slice(max(0, low - width), low), slice(high, high + width)
    closed = np.array(
        [[grid.solid[band(grid, t, side), end].mean() >= _SOLID_SHARE for end in ends] for side in (-1, 1)]
    )
    return not (closed.all(axis=0).any() or closed.all(axis=1).any())


def distinct(found: list[Gap]) -> list[Gap]:
    """One of those that overlap: the one with most wall; the surest first."""
    kept: list[Gap] = []
    for gap in sorted(found, key=lambda g: -g.wall_m):
        if all(np.linalg.norm(gap.centre_w - other.centre_w) > _SAME_M for other in kept):
            kept.append(gap)
    return kept
