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

_MIN_POINTS = 2
"""Of an occupied cell; a single one may be an outlier."""
_SIGMAS = 2.0
"""A line of sight frees space up to so many sigma before the point that was seen: beyond it, one point in fifty would
free the wall that it lies on."""
_CHUNK = 2_000_000
"""Places on lines at a time: bounds the memory."""


@dataclass(frozen=True, slots=True)
class SightLines:
    """Which keyframe observed which point: the space between was free. Unobserved space stays unknown, so a
    wall without edges stays unknown whatever lies behind it."""

    eye_w: FloatArray
    """``(L, 3)`` positions of the cameras [m]."""
    point_w: FloatArray
    """``(L, 3)`` points that they saw [m]."""
    sigma_m: FloatArray
    """``(L,)`` of the points' positions."""


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
    seen: SightLines,
    positions: FloatArray,
    resolution_m: float = 0.05,
    z_range_m: tuple[float, float] | None = None,
) -> OccupancyGrid:
    """Project obstacles to the floor and mark the space that cameras looked through as free.

    Args:
        p_w: Map points ``(P, 3)`` [m], z up.
        seen: Lines of sight; each frees the cells that it crosses within the heights.
        positions: ``(N, 3)`` where the camera was [m]: free as well.
        resolution_m: Side of a cell.
        z_range_m: Heights of obstacles; half a metre below to half a metre above the median camera by default, where
            a drone on this path would hit them.

    Raises:
        OutputError: If no point lies within the heights or the grid would be too large.
    """
    if resolution_m <= 0:
        raise OutputError(f"the resolution must be positive, got {resolution_m} m")
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
    occupied = counts >= _MIN_POINTS
    grid = np.full((height, width), UNKNOWN, dtype=np.uint8)
    box = np.array([[*lower, low], [*(lower + np.array([width, height]) * resolution_m), high]])
    free = np.concatenate([_looked_through(seen, resolution_m, box), positions[:, :2]])
    column, row = np.floor((free - lower) / resolution_m).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    grid[row[inside], column[inside]] = FREE
    grid[occupied] = OCCUPIED
    origin = (float(lower[0]), float(lower[1]))
    return OccupancyGrid(grid[::-1].copy(), resolution_m, origin, (float(low), float(high)))


def write_occupancy(path: Path, grid: OccupancyGrid) -> None:
    """Write ``path`` with ``.pgm`` and ``.yaml``."""
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


def _looked_through(seen: SightLines, resolution_m: float, box_w: FloatArray) -> FloatArray:
    """Points ``(S, 2)`` seen from above, half a cell apart, of every line within a box ``(2, 3)`` of two corners."""
    way = seen.point_w - seen.eye_w
    length = np.linalg.norm(way, axis=1)
    farthest = np.linalg.norm(np.abs(seen.eye_w - box_w[:, None]).max(axis=0), axis=1)  # of the box from each eye
    reach = np.minimum(length - _SIGMAS * seen.sigma_m - resolution_m, farthest + resolution_m)
    good = np.isfinite(length) & (reach > 0.0)  # without a sigma the range is unknown
    eye_w, way, reach = seen.eye_w[good], way[good] / length[good, None], reach[good]
    found = [np.zeros((0, 2))]
    along = np.arange(0.0, float(reach.max(initial=0.0)), 0.5 * resolution_m)
    step = max(1, _CHUNK // max(1, len(along)))
    for first in range(0, len(reach), step):
        part = slice(first, first + step)
        p = eye_w[part, None] + along[:, None] * way[part, None]
        within = (p[:, :, 2] >= box_w[0, 2]) & (p[:, :, 2] <= box_w[1, 2])
        p = p[(along < reach[part, None]) & within]
        cells = np.unique(np.floor(p[:, :2] / resolution_m).astype(int), axis=0)
        found.append((cells + 0.5) * resolution_m)
    return np.concatenate(found)
