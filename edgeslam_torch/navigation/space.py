"""Occupancy grid of log-odds that follows the drone and is rebuilt when the map is corrected.

Unknown space is not free. A depth ray frees cells only up to two standard deviations before its end, since an
overestimated depth is the dangerous error.
"""

from collections import deque
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from edgeslam_torch.navigation.drone_state import Contact, View
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapUpdate, MapViews, Places
from edgeslam_torch.types import FloatArray

CELL_M = 0.1
SIDE = 160
"""Cells per side: 16 m, enough to plan back through an adjacent room."""
LEVELS = 24
"""Cells upwards from the floor: 2.4 m."""
REACH_M = 5.0
"""Maximum depth used; beyond it small obstacles cover less than a pixel."""
_MISS, _HIT = np.float32(-0.5), np.float32(1.2)
"""Log-odds increments of a cell that a ray passes and that a ray ends in; one hit outweighs two misses."""
_LIMIT = np.float32(4.0)
FREE, SOLID = -0.8, 0.4
"""Free after two misses; solid after one hit."""
_FLOWN = -_LIMIT - 2 * _HIT
"""Where the body passed, the best measurement of free space: only three hits occupy such a cell again."""
_SHIFT = 20
"""The grid moves in steps of this many cells."""
_SIGMAS = 2.0
_MIN_DEPTH_M = 0.15
_PLACED_M = 0.3
"""Standard deviation of depth [m] above which a ray only frees cells and marks none as occupied."""
MAX_VIEWS = 240
"""Views stored to rebuild the grid after a map correction: 24 m of flight at top speed."""
_LAST_M = 1.0
"""Way flown that is kept where all else is forgotten: cells nearer than 0.6 m are below and above the picture. The
way may be off by what the submaps are, so that obstacles in view count all the same."""
_MAX_FLOWN = 4000
"""Points of the path flown that are kept: more than four minutes at 15 Hz."""
_SAME_M, _SAME_COS, _MAX_SAME = 0.1, np.cos(np.radians(4.0)), 3
"""Distance and angle within which views are redundant, and how many of them are stored while hovering."""
_CONTACT_RAD = np.radians(35.0)
"""Half-angle around a contact's direction that is marked occupied: obstacles are rarely as thin as a cell."""
_NOWHERE = np.float32(1e6)
_AROUND, _NEIGHBOURS = np.ones((5, 5), np.uint8), np.ones((3, 3), np.uint8)
_RAMP, _NEAR_END = 1.5, 1.1
"""Depth ratio within four pixels that indicates an occlusion edge (a wall seen at a grazing angle from 0.8 m has 1.4 at
`REACH_M`), and depth ratio to the nearest pixel up to which a pixel belongs to the foreground."""
_SMALL = (80, 60)
"""Maximum size of depth maps in the grid [px]: 7 cm per pixel at `REACH_M`. Larger maps are min-pooled."""


@dataclass(slots=True)
class Space:
    """Occupancy grid.

    Args:
        centre_w: Initial centre ``(2,)`` [m].
        floor_m: Height of the lowest face [m].
    """

    centre_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    floor_m: float = 0.0
    map_views: MapViews = field(default_factory=MapViews)
    """Poses of the views that it was shown."""
    _odds: FloatArray = field(init=False)
    """``(SIDE, SIDE, LEVELS)`` log-odds of occupancy."""
    _corner: np.ndarray = field(init=False)
    """``(2,)`` int, world cell at the grid's corner."""
    _views: deque[View] = field(init=False)
    _doubted_s: float = field(init=False)
    """Capture time of the newest view whose obstacles were reset (`doubt_solids`)."""
    _flown: Places = field(init=False)
    _flown_m: list[float] = field(init=False)
    """Radius around each of these points [m]."""
    _way: np.ndarray = field(init=False)
    """``(SIDE, SIDE)`` uint8, 1 where the drone flew."""
    _contacts: Places = field(init=False)

    def __post_init__(self) -> None:
        self._odds = np.zeros((SIDE, SIDE, LEVELS), np.float32)
        self._corner = np.floor(self.centre_w / CELL_M).astype(int) - SIDE // 2
        self._views, self._doubted_s = deque(maxlen=MAX_VIEWS), -np.inf
        self._flown, self._flown_m = Places(size=3), []
        self._way = np.zeros((SIDE, SIDE), np.uint8)
        self._contacts = Places(size=3)

    def observe(self, view: View) -> None:
        """Integrate a depth map."""
        self.map_views.add(view.picture, view.T_w_c)
        small = _smaller(view)
        if len(self._views) >= _MAX_SAME and _same_view(self._views[-_MAX_SAME], small):
            self._views[-1] = small
        else:
            self._views.append(small)
        self._add(small)

    def flown(self, p_w: FloatArray, radius_m: float) -> None:
        """Mark a sphere around ``(3,)`` as free: the drone's own, or the clear area required at take-off."""
        self._flown.add(self.map_views, p_w)
        self._flown.keep(slice(-_MAX_FLOWN, None))
        self._flown_m = [*self._flown_m, radius_m][-_MAX_FLOWN:]
        self._pass(p_w, radius_m)

    def was_at(self, p_w: FloatArray) -> np.ndarray:
        """Whether the drone flew within a cell of points ``(..., 2)``, bool ``(...)``."""
        at = np.floor(np.asarray(p_w) / CELL_M).astype(int) - self._corner
        inside = ((at >= 0) & (at < SIDE)).all(axis=-1)
        i, j = np.moveaxis(np.where(inside[..., None], at, 0), -1, 0)
        return np.asarray(inside & (cv2.dilate(self._way, _NEIGHBOURS)[i, j] > 0))

    def add_contact(self, contact: Contact, reach_m: float) -> None:
        """Mark an obstacle ``reach_m`` from the drone's centre permanently as occupied."""
        angle = np.arctan2(contact.towards_w[1], contact.towards_w[0]) + _CONTACT_RAD * np.array([-1.0, 0.0, 1.0])
        level = contact.p_w[:2] + reach_m * np.column_stack([np.cos(angle), np.sin(angle)])
        self._contacts.add(self.map_views, np.column_stack([level, np.full(len(level), contact.p_w[2])]))

    def follow(self, p_w: FloatArray) -> None:
        """Shift the grid when the drone ``(3,)`` leaves its centre; cells that fall off are lost."""
        wanted = np.floor(np.asarray(p_w[:2]) / CELL_M).astype(int) - SIDE // 2
        step = ((wanted - self._corner) / _SHIFT).astype(int) * _SHIFT
        if not step.any():
            return
        moved, way = np.zeros_like(self._odds), np.zeros_like(self._way)
        old = [slice(max(0, s), min(SIDE, SIDE + s)) for s in step]
        new = [slice(max(0, -s), min(SIDE, SIDE - s)) for s in step]
        if all(s.stop > s.start for s in old):
            moved[new[0], new[1]] = self._odds[old[0], old[1]]
            way[new[0], new[1]] = self._way[old[0], old[1]]
        self._odds, self._way, self._corner = moved, way, self._corner + step

    def correct(self, update: MapUpdate) -> None:
        """Apply a map correction to all that is tied to views, and rebuild the grid from the stored ones."""
        self.map_views.correct(update)
        for k, view in enumerate(self._views):
            T_w_c = self.map_views.pose_of(view.picture)
            T_w_c = view.T_w_c if T_w_c is None else T_w_c
            self._views[k] = replace(view, T_w_c=T_w_c, depth_m=update.ratio * view.depth_m)
        self._build()

    def forget_before(self, seen_s: float) -> None:
        """Drop everything but the views since a time, the last metre flown, and contacts.

        No view shows what was felt, nor what is close beside the drone: the way that it came is its way out of a dead
        end.
        """
        kept = [view for view in self._views if view.stamp_s >= seen_s]
        self._views = deque(kept, maxlen=MAX_VIEWS)
        p_w = self._flown.p_w
        far = np.flatnonzero(np.linalg.norm(p_w - p_w[-1:], axis=1) > _LAST_M)
        lately = slice(int(far[-1]) + 1 if len(far) else 0, None)
        self._flown.keep(lately)
        self._flown_m = self._flown_m[lately]
        self._build()

    def doubt_solids(self) -> None:
        """Reset occupied cells to unknown until they are observed again; free cells and contacts stay."""
        self._odds[self._odds > 0.0] = 0.0
        self._doubted_s = max((view.stamp_s for view in self._views), default=-np.inf)

    def _build(self) -> None:
        self._odds[:], self._way[:] = 0.0, 0
        for view in self._views:
            self._add(view, fills=view.stamp_s > self._doubted_s)
        for p_w, radius_m in zip(self._flown.p_w, self._flown_m, strict=True):
            self._pass(p_w, radius_m)

    def layer(self, height_m: float, half_m: float) -> Layer:
        """Slice for flight at a height; a cell is free if all cells within ``half_m`` above and below are."""
        low = int(np.floor((height_m - half_m - self.floor_m) / CELL_M + 1e-6))
        high = int(np.ceil((height_m + half_m - self.floor_m) / CELL_M - 1e-6))
        if low < 0 or high > LEVELS:
            raise ValueError(f"a height of {height_m:.2f} m is outside the grid of {LEVELS * CELL_M:.1f} m")
        band = self._odds[:, :, low:high]
        free, solid = np.asarray((band < FREE).all(2)), np.asarray((band > SOLID).any(2))
        cell = np.floor(self._contacts.p_w[:, :2] / CELL_M).astype(int) - self._corner
        i, j = cell[((cell >= 0) & (cell < SIDE)).all(axis=1)].T
        free[i, j], solid[i, j] = False, True
        return Layer(free, solid, self._corner * CELL_M, CELL_M)

    def upright(self, low_m: float, high_m: float, share: float) -> np.ndarray:
        """Columns ``(SIDE, SIDE)`` bool of which at least this share between two heights is occupied."""
        low, high = (round((z - self.floor_m) / CELL_M) for z in (low_m, high_m))
        if not 0 <= low < high <= LEVELS:
            raise ValueError(f"heights {low_m:.2f} to {high_m:.2f} m are outside the grid of {LEVELS * CELL_M:.1f} m")
        return np.asarray((self._odds[:, :, low:high] > SOLID).mean(2) >= share)

    def _add(self, view: View, fills: bool = True) -> None:
        depth = np.where(np.isfinite(view.depth_m) & (view.depth_m > 0), view.depth_m, 0.0).astype(np.float32)
        self._carve(view, depth)
        if fills:
            self._fill(view, depth)

    def _carve(self, view: View, depth: FloatArray) -> None:
        """Free the cells that lie wholly in front of the depth of all pixels that they cover."""
        height, width = depth.shape
        index, p_c = self._cells_before(view, height, width)
        if len(index) == 0:
            return
        z = p_c[:, 2]
        u, v = ((view.K[k, k] * p_c[:, k] / z + view.K[k, 2]) for k in (0, 1))
        sure = depth * np.exp(-_SIGMAS * view.sigma_log.astype(np.float32))
        # A cell covers several pixels: take their minimum from a pyramid.
        half_px = 0.5 * CELL_M * view.K[0, 0] / z
        level = np.clip(np.ceil(np.log2(np.maximum(half_px, 1.0))), 0, 5).astype(int)
        nearest = np.zeros(len(z), np.float32)
        for k in range(int(level.max()) + 1):
            size = 2 * 2**k + 1
            least = cv2.erode(sure, np.ones((size, size), np.uint8)) if k else sure
            mine = level == k
            row = np.clip(np.rint(v[mine]), 0, height - 1).astype(int)
            column = np.clip(np.rint(u[mine]), 0, width - 1).astype(int)
            nearest[mine] = least[row, column]
        inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        passed = index[inside & (z + 0.5 * CELL_M < nearest)]
        odds = self._odds.reshape(-1)
        odds[passed] = np.minimum(odds[passed], np.maximum(odds[passed] + _MISS, -_LIMIT))

    def _cells_before(self, view: View, height: int, width: int) -> tuple[np.ndarray, FloatArray]:
        """Cells in the field of view: flat index ``(N,)`` and centre in the camera frame ``(N, 3)``."""
        T = view.T_w_c
        reach = int(np.ceil(REACH_M / CELL_M))
        here = np.floor(T[:2, 3] / CELL_M).astype(int) - self._corner
        low, high = np.maximum(here - reach, 0), np.minimum(here + reach + 1, SIDE)
        if (low >= high).any():
            return np.zeros(0, int), np.zeros((0, 3))
        i, j = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
        x = (i + self._corner[0] + 0.5) * CELL_M - T[0, 3]
        y = (j + self._corner[1] + 0.5) * CELL_M - T[1, 3]
        ahead = T[:2, 2] / max(float(np.linalg.norm(T[:2, 2])), 1e-6)
        along, across = x * ahead[0] + y * ahead[1], np.abs(y * ahead[0] - x * ahead[1])
        widest = max(view.K[0, 2], width - view.K[0, 2]) / view.K[0, 0]
        seen = (along > 0) & (across < 1.15 * widest * along + CELL_M) & (along < REACH_M)
        i, j, x, y = i[seen], j[seen], x[seen], y[seen]
        z = (np.arange(LEVELS) + 0.5) * CELL_M + self.floor_m - T[2, 3]
        level = np.stack([x, y], axis=1).astype(np.float32) @ T[:2, :3].astype(np.float32)
        p_c = level[:, None, :] + z.astype(np.float32)[:, None] * T[2, :3].astype(np.float32)
        highest = np.maximum(view.K[1, 2], height - view.K[1, 2]) / view.K[1, 1]
        front = (p_c[..., 2] > _MIN_DEPTH_M) & (np.abs(p_c[..., 1]) < highest * p_c[..., 2])
        index = (i * SIDE + j)[:, None] * LEVELS + np.arange(LEVELS)
        return index[front], p_c[front]

    def _fill(self, view: View, depth: FloatArray) -> None:
        """Mark cells in which rays end as occupied."""
        height, width = depth.shape
        known = view.sigma_log * depth < _PLACED_M
        v, u = np.nonzero((depth > _MIN_DEPTH_M) & (depth < REACH_M) & known & ~_between(depth))
        z = depth[v, u]
        rays = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones(len(u))], 1)
        p = (z[:, None] * rays) @ view.T_w_c[:3, :3].T + view.T_w_c[:3, 3]
        self.mark(p)

    def mark(self, p_w: FloatArray) -> None:
        """Mark cells of surface points ``(N, 3)`` [m] as occupied."""
        cell = np.floor(p_w / CELL_M).astype(int)
        cell[:, 2] = np.floor((p_w[:, 2] - self.floor_m) / CELL_M).astype(int)
        cell[:, :2] -= self._corner
        inside = ((cell >= 0) & (cell < [SIDE, SIDE, LEVELS])).all(1)
        index = np.unique(np.ravel_multi_index(tuple(cell[inside].T), self._odds.shape))
        odds = self._odds.reshape(-1)
        before = np.where(odds[index] < -_LIMIT, odds[index], np.maximum(odds[index], _MISS))
        odds[index] = np.minimum(before + _HIT, _LIMIT)

    def _pass(self, p_w: FloatArray, radius_m: float) -> None:
        """Mark a position of the drone as flown and free."""
        i, j = np.floor(p_w[:2] / CELL_M).astype(int) - self._corner
        if 0 <= i < SIDE and 0 <= j < SIDE:
            self._way[i, j] = 1
        self._clear(p_w, radius_m)

    def _clear(self, p_w: FloatArray, radius_m: float) -> None:
        offset = np.array([*self._corner * CELL_M, self.floor_m])
        low = np.maximum(np.floor((p_w - radius_m - offset) / CELL_M).astype(int), 0)
        high = np.minimum(np.floor((p_w + radius_m - offset) / CELL_M).astype(int) + 1, [SIDE, SIDE, LEVELS])
        if (low < high).all():
            axes = [(np.arange(a, b) + 0.5) * CELL_M + o - x for a, b, o, x in zip(low, high, offset, p_w, strict=True)]
            x, y, z = np.meshgrid(*axes, indexing="ij")
            part = self._odds[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
            part[x * x + y * y + z * z < (radius_m + 0.5 * CELL_M) ** 2] = _FLOWN


def _between(depth: FloatArray) -> np.ndarray:
    """Pixels ``(H, W)`` on the ramp that a depth network draws across an occlusion edge; there is no surface.

    Otherwise the ramp between a door frame and the room behind it would close the door.
    """
    nearest = cv2.erode(np.where(depth > 0, depth, _NOWHERE), _AROUND)
    farthest = cv2.dilate(np.where(depth > 0, depth, np.float32(0.0)), _AROUND)
    return np.asarray((farthest > _RAMP * nearest) & (depth > _NEAR_END * nearest))


def _same_view(one: View, other: View) -> bool:
    near = float(np.linalg.norm(one.T_w_c[:3, 3] - other.T_w_c[:3, 3])) < _SAME_M
    return near and float(one.T_w_c[:3, 2] @ other.T_w_c[:3, 2]) > _SAME_COS


def _smaller(view: View) -> View:
    """The view at storage size, min-pooled; each pixel keeps the standard deviation of the nearest depth."""
    height, width = view.depth_m.shape
    step = max(1, -(-width // _SMALL[0]), -(-height // _SMALL[1]))
    if step == 1:
        return view
    known = np.where(np.isfinite(view.depth_m) & (view.depth_m > 0), view.depth_m, 0.0).astype(np.float32)
    depth, sigma = _blocks(known, step), _blocks(view.sigma_log, step)
    nearest = depth.argmin(axis=2, keepdims=True)
    depth, sigma = (np.take_along_axis(grid, nearest, axis=2)[..., 0] for grid in (depth, sigma))
    K = view.K.copy()
    K[:2] /= step
    K[:2, 2] += 0.5 / step - 0.5
    return replace(view, depth_m=depth, sigma_log=sigma, K=K)


def _blocks(grid: FloatArray, step: int) -> FloatArray:
    """Pooling blocks ``(H // step, W // step, step * step)``."""
    rows, columns = (n // step for n in grid.shape)
    cut = grid[: rows * step, : columns * step].reshape(rows, step, columns, step)
    return cut.swapaxes(1, 2).reshape(rows, columns, step * step)
