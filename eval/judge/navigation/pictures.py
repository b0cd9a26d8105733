"""Judged flights in the true world: the shortest path there, and top views."""

import cv2
import numpy as np

from edgeslam_torch.eval.judge.navigation.flown import Flown
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.pilot import BAND_M
from edgeslam_torch.navigation.route import cost_to_go
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import FloatArray

_CELL_M = 0.1
_PX = 6
"""A cell's side in the picture."""
_WALL, _AIR, _START, _GOAL = (60, 60, 60), (235, 235, 235), (0, 150, 0), (0, 0, 220)
_WAY = (200, 90, 20)


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
    """Length [m] of the shortest path from start to goal in the true map under the planner's limits; infinite if there
    is none."""
    layer, start = true_layer(site, limits), np.zeros(2)
    plan = cost_to_go(layer, layer.cells(site.goal_w[None, :2]), limits.clearance_m(0.0), layer.cells(start))
    way = plan.way(start, 100.0)
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) if np.isfinite(plan.at(start)) else float("inf")


def top_view(flown: Flown) -> np.ndarray:
    """World, path flown, start and goal: ``(H, W, 3)`` BGR, x to the right, y up."""
    site = named_site(flown.case.world, flown.case.seed)
    layer = true_layer(site, NavLimits())
    image = np.full((*layer.free.shape, 3), _AIR, np.uint8)
    image[layer.solid] = _WALL
    image = np.ascontiguousarray(image[:, ::-1].transpose(1, 0, 2))
    image = np.asarray(cv2.resize(image, None, fx=_PX, fy=_PX, interpolation=cv2.INTER_NEAREST))
    height = layer.free.shape[1]

    def pixel(p: FloatArray) -> tuple[int, int]:
        x, y = (p[:2] - layer.corner_w) / layer.cell_m * _PX
        return round(x), round(height * _PX - y)

    track = np.array(flown.track_w).reshape(-1, 3)
    for a, b in zip(track[:-1], track[1:], strict=True):
        cv2.line(image, pixel(a), pixel(b), _WAY, 2, cv2.LINE_AA)
    cv2.circle(image, pixel(np.zeros(2)), 6, _START, -1, cv2.LINE_AA)
    cv2.circle(image, pixel(site.goal_w), 6, _GOAL, -1, cv2.LINE_AA)
    words = f"{flown.case.world} {flown.case.seed} {flown.case.fault}: {flown.ended}, {flown.contacts} contacts"
    cv2.rectangle(image, (0, 0), (image.shape[1], 21), (30, 30, 30), -1)
    cv2.putText(image, words, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return image
