"""Oracle: the shortest path in the true map under the planner's limits."""

import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import BAND_M
from edgeslam_torch.navigation.route import cost_to_go
from edgeslam_torch.synthetic.sites.site import Site

_CELL_M = 0.1


def true_layer(site: Site, limits: NavLimits) -> Layer:
    """True layer at the flight height, in the drone's world."""
    corners = np.array([[x, y, 0.0] for x in site.world.bounds_w[:, 0] for y in site.world.bounds_w[:, 1]])
    local = (corners - site.T_site_w[:3, 3]) @ site.T_site_w[:3, :3]
    low = np.floor(local[:, :2].min(0) / _CELL_M) * _CELL_M - _CELL_M
    shape = np.ceil((local[:, :2].max(0) - low) / _CELL_M).astype(int) + 1
    x, y = (low[k] + (np.arange(shape[k]) + 0.5) * _CELL_M for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    half = limits.radius_m + BAND_M
    away = np.min([site.clearance(np.c_[grid, np.full(len(grid), limits.height_m + dz)]) for dz in (-half, 0, half)], 0)
    solid = (away < 0.5 * _CELL_M).reshape(shape)
    return Layer(~solid, solid, low, _CELL_M)


def shortest_m(site: Site, limits: NavLimits) -> float:
    """Length of the shortest path from start to goal [m]; infinite if there is none."""
    layer = true_layer(site, limits)
    start = layer.cells(np.zeros(2))
    plan = cost_to_go(layer, layer.cells(site.goal_w[None, :2]), limits.clearance_m(0.0), start)
    way = plan.way(np.zeros(2), 100.0)
    if not np.isfinite(plan.at(np.zeros(2))):
        return float("inf")
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
