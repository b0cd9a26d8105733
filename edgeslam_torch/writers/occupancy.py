"""A metric edge map as a 2-D occupancy grid: the PGM and YAML pair of the ROS map_server.

http://wiki.ros.org/map_server: white is free, black occupied, grey (205) unknown; the first image row is the largest
y; ``origin`` is the lower left corner in the world.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.atomic import write_atomically, write_text
from edgeslam_torch.types import FloatArray

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
MAX_CELLS = 50_000_000
"""Maximum number of cells: 7 km at 1 m, 350 m at 5 cm; more is a mistake of scale or resolution."""

_AZIMUTHS = 720
"""One ray per half degree of a camera's fan."""


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """Cells seen from above."""

    cells: NDArray[np.uint8]
    """``(H, W)`` of `FREE`, `OCCUPIED`, `UNKNOWN`; row 0 is the largest y."""
    resolution_m: float
    origin: tuple[float, float]
    """World x, y of the lower left corner [m]."""
    z_range_m: tuple[float, float]
    """Heights whose points count as obstacles."""


def occupancy_grid(
    p_w: FloatArray,
    T_w_c: FloatArray,
    resolution_m: float = 0.05,
    z_range_m: tuple[float, float] | None = None,
    min_points: int = 2,
    half_fov_rad: float = 0.5,
) -> OccupancyGrid:
    """Project obstacles to the floor and mark the space that cameras looked through as free.

    Args:
        p_w: Map points ``(P, 3)`` [m], z up.
        T_w_c: Camera to world ``(N, 4, 4)`` of the views that free space.
        resolution_m: Side of a cell.
        z_range_m: Heights of obstacles; half a metre below to half a metre above the median camera by default, where
            a drone on this path would hit them.
        min_points: Minimum number of points of an occupied cell; a single one may be an outlier.
        half_fov_rad: Half the horizontal field of view of a camera.

    Raises:
        OutputError: If no point lies within the heights or the grid would be too large.
    """
    if resolution_m <= 0:
        raise OutputError(f"the resolution must be positive, got {resolution_m} m")
    positions = T_w_c[:, :3, 3]
    middle = float(np.median(positions[:, 2]))
    low, high = z_range_m or (middle - 0.5, middle + 0.5)
    p = p_w[np.isfinite(p_w).all(axis=1)]
    p = p[(p[:, 2] >= low) & (p[:, 2] <= high)].astype(np.float64)
    if len(p) == 0:
        raise OutputError(f"no map point between {low:.2f} and {high:.2f} m: choose other heights (--min-z, --max-z)")
    everything = np.concatenate([np.quantile(p[:, :2], [0.002, 0.998], axis=0), positions[:, :2]])
    lower = np.floor(everything.min(axis=0) / resolution_m - 2) * resolution_m
    width, height = (np.ceil((everything.max(axis=0) - lower) / resolution_m) + 2).astype(int)
    if width * height > MAX_CELLS:
        raise OutputError(f"the grid would have {width} x {height} cells: is the map metric? try a larger --resolution")
    counts = np.zeros((height, width), dtype=np.int64)
    cell = np.floor((p[:, :2] - lower) / resolution_m).astype(int)
    inside = (cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height)
    np.add.at(counts, (cell[inside, 1], cell[inside, 0]), 1)
    occupied = counts >= min_points
    grid = np.full((height, width), UNKNOWN, dtype=np.uint8)
    solid = (np.argwhere(occupied)[:, ::-1] + 0.5) * resolution_m + lower
    for T in T_w_c:
        _free_fan(grid, T, solid, lower, resolution_m, half_fov_rad)
    grid[occupied] = OCCUPIED
    origin = (float(lower[0]), float(lower[1]))
    return OccupancyGrid(grid[::-1].copy(), resolution_m, origin, (float(low), float(high)))


def write_occupancy(path: Path, grid: OccupancyGrid) -> None:
    """Write ``path`` with ``.pgm`` and ``.yaml``.

    Raises:
        OSError: If the file cannot be written.
    """
    picture, record = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    height, width = grid.cells.shape
    data = f"P5\n{width} {height}\n255\n".encode("ascii") + grid.cells.tobytes()
    write_atomically(picture, lambda file: file.write(data))
    fields = {
        "image": picture.name,
        "mode": "trinary",
        "resolution": grid.resolution_m,
        "origin": [grid.origin[0], grid.origin[1], 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    remark = f"# obstacles between {grid.z_range_m[0]:.3f} and {grid.z_range_m[1]:.3f} m\n"
    write_text(record, remark + yaml.safe_dump(fields, sort_keys=False))


def _free_fan(
    grid: NDArray[np.uint8],
    T: FloatArray,
    solid: FloatArray,
    lower: FloatArray,
    resolution_m: float,
    half_fov_rad: float,
) -> None:
    """Mark cells between a camera and the nearest obstacle of each ray as free; rays without an obstacle mark
    none."""
    position, forward = T[:2, 3], T[:2, 2]
    if np.linalg.norm(forward) < 0.2:  # looks straight up or down: no fan
        return
    offset = solid - position
    distance = np.linalg.norm(offset, axis=1)
    angle = np.arctan2(offset[:, 1], offset[:, 0]) - np.arctan2(forward[1], forward[0])
    angle = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    ahead = (np.abs(angle) < half_fov_rad) & (distance > resolution_m)
    if not ahead.any():
        return
    ray = np.floor((angle[ahead] + np.pi) / (2 * np.pi) * _AZIMUTHS).astype(int)
    nearest = np.full(_AZIMUTHS, np.inf)
    np.minimum.at(nearest, ray, distance[ahead])
    hit = np.flatnonzero(np.isfinite(nearest))
    azimuth = (hit + 0.5) / _AZIMUTHS * 2 * np.pi - np.pi + np.arctan2(forward[1], forward[0])
    steps = np.arange(0.0, float(nearest[hit].max()), 0.5 * resolution_m)
    for a, reach in zip(azimuth, nearest[hit], strict=True):
        along = steps[steps < reach - resolution_m]
        cell = np.floor((position + along[:, None] * [np.cos(a), np.sin(a)] - lower) / resolution_m).astype(int)
        ok = (cell >= 0).all(axis=1) & (cell[:, 0] < grid.shape[1]) & (cell[:, 1] < grid.shape[0])
        grid[cell[ok, 1], cell[ok, 0]] = FREE
