"""Pathways: free corridors between walls, with width and direction."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.openings.wall_frame import CELL_SIGMAS, WallGrid, Walls, runs, wall_directions, wall_grid
from edgeslam_torch.types import FloatArray

NARROWEST_M, WIDEST_M = 0.8, 3.2
"""Width of a corridor; wider spaces are rooms."""
_SHORTEST_M, _LONGER = 2.0, 1.5
"""Minimum length [m] and minimum ratio of length to width."""
_STEADY_M = 0.8
"""Maximum change of width between neighbouring sections; a door ends the corridor."""
_BOUND = 0.6
"""Minimum share of sections bounded by obstacles on both sides."""


@dataclass(frozen=True, slots=True)
class Pathway:
    """A straight free corridor."""

    ends_w: FloatArray
    """``(2, 2)`` ends of the centre line, the nearer to the drone first [m]."""
    width_m: float
    """Median over the sections."""
    width_sigma_m: float

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return float(np.linalg.norm(self.ends_w[1] - self.ends_w[0]))

    @property
    def direction_w(self) -> FloatArray:
        """``(2,)`` unit vector from its first end to its second."""
        return np.asarray((self.ends_w[1] - self.ends_w[0]) / self.length_m)

    def beside_m(self, p_w: FloatArray) -> float:
        """Distance of a point ``(2,)`` from the centre line."""
        along = float(np.clip((p_w - self.ends_w[0]) @ self.direction_w, 0.0, self.length_m))
        return float(np.linalg.norm(p_w - self.ends_w[0] - along * self.direction_w))


@dataclass(frozen=True, slots=True)
class _Section:
    """Free cells across the corridor, from a low to a high cell of a column."""

    s: int
    low: int
    high: int
    bound: bool
    """Whether obstacles bound it on both sides."""

    @property
    def middle(self) -> float:
        return 0.5 * (self.low + self.high - 1)


def pathways(walls: Walls, here_w: FloatArray) -> list[Pathway]:
    """Corridors around a point ``(2,)``, the longest first."""
    found = []
    for angle in wall_directions(walls, here_w):
        grid = wall_grid(walls, here_w, angle)
        found += [way for chain in _chains(grid) if (way := _pathway(grid, chain, here_w)) is not None]
    kept: list[Pathway] = []
    for way in sorted(found, key=lambda w: -w.length_m):
        if not any(_within(way, other) for other in kept):
            kept.append(way)
    return kept


def _chains(grid: WallGrid) -> list[list[_Section]]:
    """Chains of successive overlapping sections."""
    ending: list[list[_Section]] = []
    done: list[list[_Section]] = []
    for s in range(grid.free.shape[1]):
        going = []
        for section in _sections(grid, s):
            before = next((c for c in ending if _follows(section, c[-1], grid.cell_m)), None)
            if before is None:
                going.append([section])
            else:
                ending.remove(before)
                going.append([*before, section])
        done += ending
        ending = going
    return done + ending


def _sections(grid: WallGrid, s: int) -> list[_Section]:
    column, solid = grid.free[:, s], grid.solid[:, s]
    found = []
    for low, high in runs(column):
        if NARROWEST_M <= (high - low) * grid.cell_m <= WIDEST_M:
            ends = solid[max(0, low - 2) : low].any(), solid[high : high + 2].any()
            found.append(_Section(s, int(low), int(high), bool(all(ends))))
    return found


def _follows(section: _Section, last: _Section, cell_m: float) -> bool:
    overlap = min(section.high, last.high) - max(section.low, last.low)
    change = abs((section.high - section.low) - (last.high - last.low)) * cell_m
    return overlap * cell_m > 0.5 * NARROWEST_M and change < _STEADY_M


def _pathway(grid: WallGrid, chain: list[_Section], here_w: FloatArray) -> Pathway | None:
    widths = np.array([(c.high - c.low + 1) * grid.cell_m for c in chain])
    width, length = float(np.median(widths)), len(chain) * grid.cell_m
    if length < max(_SHORTEST_M, _LONGER * width) or np.mean([c.bound for c in chain]) < _BOUND:
        return None
    # Fit a line: furniture at one side shifts some of the midpoints.
    slope, at = np.polyfit([c.s for c in chain], [c.middle for c in chain], 1)
    if abs(math.atan(slope)) > math.radians(15.0):
        return None
    ends = np.array([grid.at(c.s, slope * c.s + at) for c in (chain[0], chain[-1])])
    if np.linalg.norm(ends[1] - here_w) < np.linalg.norm(ends[0] - here_w):
        ends = ends[::-1].copy()
    return Pathway(ends, width, math.hypot(grid.cell_m * CELL_SIGMAS, float(np.std(widths))))


def _within(way: Pathway, other: Pathway) -> bool:
    """Whether a pathway is mostly part of a longer one."""
    middle = way.ends_w.mean(0)
    parallel = abs(float(way.direction_w @ other.direction_w)) > math.cos(math.radians(25.0))
    return parallel and other.beside_m(middle) < 0.5 * other.width_m
