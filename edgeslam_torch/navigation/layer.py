"""Horizontal slice of the occupancy grid, used for planning."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage

from edgeslam_torch.types import FloatArray


def distance_cells(mask: np.ndarray) -> FloatArray:
    """Distance of the cells ``(X, Y)`` of a mask to the nearest cell outside it [cells]; 0 outside."""
    away = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float64)


@dataclass(frozen=True)
class Layer:
    """Free and occupied cells at one height; cells that are neither are unknown."""

    free: np.ndarray
    """``(X, Y)`` bool."""
    solid: np.ndarray
    """``(X, Y)`` bool."""
    corner_w: FloatArray
    """``(2,)`` lower corner of the first cell [m]."""
    cell_m: float

    @cached_property
    def clearance_m(self) -> FloatArray:
        """``(X, Y)`` distance [m] of each free cell's centre to the nearest cell that is not free; 0 elsewhere."""
        away = distance_cells(np.pad(self.free, 1))[1:-1, 1:-1]
        return np.maximum(away - 0.5, 0.0) * self.cell_m

    @cached_property
    def from_solid_m(self) -> FloatArray:
        """``(X, Y)`` distance [m] of each cell's centre to the border of the nearest occupied cell."""
        if not self.solid.any():
            return np.full(self.solid.shape, np.inf)
        return np.maximum(distance_cells(~self.solid) - 0.5, 0.0) * self.cell_m

    def part_around(self, open_: np.ndarray, p_w: FloatArray) -> np.ndarray:
        """The connected parts of cells ``(X, Y)`` within two cells of a point ``(2,)``."""
        parts, _ = ndimage.label(open_)
        i, j = self.cells(p_w)
        around = parts[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3]
        return np.isin(parts, around[around > 0])

    def cells(self, p_w: FloatArray) -> np.ndarray:
        """Cells ``(..., 2)`` int of points ``(..., 2)``, clipped to the grid."""
        index = np.floor((np.asarray(p_w) - self.corner_w) / self.cell_m).astype(int)
        return np.clip(index, 0, np.array(self.free.shape) - 1)

    def centres(self, cells: np.ndarray) -> FloatArray:
        """Centres ``(..., 2)`` [m] of cells."""
        return self.corner_w + (np.asarray(cells) + 0.5) * self.cell_m

    def clearance_at(self, p_w: FloatArray) -> FloatArray:
        """Clearance [m] at points ``(..., 2)``, interpolated between cells."""
        return self.interpolated(self.clearance_m, p_w, 0.0)

    def from_solid_at(self, p_w: FloatArray) -> FloatArray:
        """Distance to obstacles [m] at points ``(..., 2)``, interpolated between cells; at most the grid's width."""
        widest = max(self.solid.shape) * self.cell_m
        return self.interpolated(np.minimum(self.from_solid_m, widest), p_w, widest)

    def interpolated(self, grid: FloatArray, p_w: FloatArray, outside: float) -> FloatArray:
        """Values of a grid ``(X, Y)`` at points ``(..., 2)``, and ``outside`` of it."""
        at = (np.asarray(p_w) - self.corner_w) / self.cell_m - 0.5
        flat = at.reshape(-1, 2).T
        value = ndimage.map_coordinates(grid, flat, order=1, mode="constant", cval=outside)
        return np.asarray(value).reshape(at.shape[:-1])
