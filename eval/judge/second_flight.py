"""Two flights, of which the second starts with the map of the first: time to relocalise, agreement of both scales.

A second flight may start outside the first map, so depth maps determine when a known place comes into view. The scale
is measured by depth maps as well as by path lengths, since bending of map or ground truth changes the latter by some
per cent.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import interpolate, open_dataset, open_depth
from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.judge.score import Figures, Truth, score
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

NEVER_S = 1e3
"""Stands for a place that is never recognised."""
VIEWS_S, GRID_PX = 0.5, 16
"""Time between the views, and distance of the pixels, that are compared."""
KNOWN_SHARE, KNOWN_RAD, KNOWN_RATIO = 0.5, np.deg2rad(20.0), 1.5
"""A view is known when this share of it was in one view of the first flight within this angle and ratio of distances,
the limits of keypoint matching."""
SAME_DEPTH = 0.05
"""Relative difference of two depths of one point."""
SAME_UNIT = 0.15
"""The same while a map's scale is estimated."""


def compared(second: Path, truth: Truth, first: Path, first_truth: Truth) -> Figures:
    """Figures of the second flight's run beside the first one's.

    Returns:
        ``placed_after_s`` until the first frame in the map of the first flight, ``placed`` share of frames in it,
        ``metres_off`` absolute log of the ratio of the true lengths of the two flights' units by their ways,
        ``metres_off_depth`` by depth maps; ``known_after_s`` until the first view that the first flight knew, and
        ``placed_late_s`` from then on, 0 when it never came.
    """
    runs, truths = (open_run(first), open_run(second)), (first_truth, truth)
    found = runs[1].summary["atlas"]
    after_s = NEVER_S if found["found_after_s"] is None else found["found_after_s"]
    scales = [score(run.path, its)[0].get("scale_sim3") for run, its in zip(runs, truths, strict=True)]
    figures: Figures = {
        "placed_after_s": after_s,
        "placed": found["frames_placed"] / max(runs[1].summary["frames"], 1),
        "metres_off": _ratio(scales),
    }
    views = [views_of(run, its.poses) if its.poses is not None else [] for run, its in zip(runs, truths, strict=True)]
    if not all(views):
        return figures
    known_s = known_after_s([view for _, view in views[0]], views[1], float(runs[1].trajectory.stamps_s[0]))
    metres = []
    for run, own in zip(runs, views, strict=True):
        cloud = run.cloud("anchors.ply")
        points = np.zeros((0, 3)) if cloud is None else cloud.p_w.astype(np.float64)
        metres.append(metre_by_depth([view for _, view in own], points))
    return figures | {
        "known_after_s": known_s,
        "placed_late_s": max(0.0, after_s - known_s) if math.isfinite(known_s) else 0.0,
        "metres_off_depth": _ratio(metres),
    }


def _ratio(pair: list[float | None]) -> float | None:
    """Absolute log of the ratio of two positive numbers."""
    first, second = pair
    return abs(math.log(second / first)) if first and second else None


@dataclass(frozen=True, slots=True)
class View:
    """A depth map and its true place."""

    camera: Camera
    T_w_c: FloatArray
    """``(4, 4)`` true pose of the depth camera."""
    depth_m: FloatArray
    """``(H, W)``, 0 where nothing was measured."""
    T_d_c: FloatArray
    """``(4, 4)`` the run's camera in the depth camera's frame."""
    T_run_w_c: FloatArray
    """``(4, 4)`` the run's pose at that time, in its own world and unit."""

    def grid(self) -> FloatArray:
        """Points of the world ``(N, 3)`` that it shows, `GRID_PX` apart."""
        v, u = np.mgrid[0 : self.camera.height : GRID_PX, 0 : self.camera.width : GRID_PX].reshape(2, -1)
        depth = self.depth_m[v, u]
        p_c = self.camera.back_project(np.stack([u, v], axis=1)[depth > 0].astype(np.float64), depth[depth > 0])
        return se3.transform(self.T_w_c, p_c)

    def depths_at(self, p_c: FloatArray) -> FloatArray:
        """Measured depth at points of its camera frame ``(N, 3)``, NaN where there is none."""
        front = p_c[:, 2] > 0.05
        uv = np.rint(self.camera.project(np.where(front[:, None], p_c, 1.0))).astype(np.int64)
        inside = front & ((uv >= 0) & (uv < [self.camera.width, self.camera.height])).all(axis=1)
        depth = np.zeros(len(p_c))
        depth[inside] = self.depth_m[uv[inside, 1], uv[inside, 0]]
        return np.where(depth > 0, depth, np.nan)

    def covers(self, p_w: FloatArray, centre_w: FloatArray) -> FloatArray:
        """Which points ``(N, 3)`` it shows similarly to a view from another position ``(3,)``."""
        p_c = se3.transform(se3.inverse(self.T_w_c), p_w)
        visible = np.abs(self.depths_at(p_c) / np.maximum(p_c[:, 2], 1e-9) - 1.0) <= SAME_DEPTH
        mine, theirs = p_w - self.T_w_c[:3, 3], p_w - centre_w
        near, far = np.linalg.norm(mine, axis=1), np.linalg.norm(theirs, axis=1)
        cosine = np.einsum("ij,ij->i", mine, theirs) / (near * far)
        return visible & (cosine >= np.cos(KNOWN_RAD)) & (np.abs(np.log(near / far)) <= math.log(KNOWN_RATIO))


def views_of(run: RunFolder, place: Path) -> list[tuple[float, View]]:
    """Depth maps along a run with their stamps, `VIEWS_S` apart; none where there are none."""
    try:
        depth, truth = open_depth(place), open_dataset(place).truth
    except EvaluationError:
        return []
    maps, camera = depth.maps, depth.maps.taken_by(depth.camera)
    stamps = run.trajectory.stamps_s
    inside = np.flatnonzero((maps.stamps_s >= stamps[0] - 0.05) & (maps.stamps_s <= stamps[-1] + 0.05))
    period = np.floor((maps.stamps_s[inside] - stamps[0]) / VIEWS_S + 1e-6)
    rows = inside[np.diff(period, prepend=-np.inf) > 0]
    views = []
    for row, T, known in zip(rows.tolist(), *interpolate(truth, maps.stamps_s[rows]), strict=True):
        stamp = float(maps.stamps_s[row])
        pose = run.trajectory.T_w_c[int(np.abs(stamps - stamp).argmin())]
        if known:
            view = View(camera, T @ maps.T_c_d, maps.read(row, depth.camera), se3.inverse(maps.T_c_d), pose)
            views.append((stamp, view))
    return views


def known_after_s(first: list[View], second: list[tuple[float, View]], begin_s: float) -> float:
    """Time until a view of the second flight is known; infinite when none is."""
    for stamp_s, view in second:
        p_w = view.grid()
        if any(earlier.covers(p_w, view.T_w_c[:3, 3]).mean() >= KNOWN_SHARE for earlier in first if len(p_w)):
            return max(0.0, stamp_s - begin_s)
    return math.inf


def metre_by_depth(views: list[View], p_w: FloatArray) -> float | None:
    """True metres per unit of a run's map points ``(P, 3)``, by the depth maps in which they are seen."""
    logs = [np.zeros(0)]
    for view in views:
        p_c = se3.transform(view.T_d_c @ se3.inverse(view.T_run_w_c), p_w)
        ratio = np.log(view.depths_at(p_c) / np.where(p_c[:, 2] > 0, p_c[:, 2], np.nan))
        logs.append(ratio[np.abs(ratio) <= SAME_UNIT])  # the others are hidden, or a map's error
    together = np.concatenate(logs)
    return math.exp(float(np.median(together))) if len(together) else None
