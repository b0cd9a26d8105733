"""Cell of two flights: the first saves its map, the second starts with it and is scored.

Scored are the time to relocalise and the agreement of both scales. A second flight may start outside the first map, so
depth maps determine when a known place comes into view. The scale is measured by depth maps as well as by path lengths,
since bending of map or ground truth changes the latter by some per cent.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import interpolate, open_dataset, open_depth
from edgeslam_torch.eval.inputs.run_folder import RunFolder, open_run
from edgeslam_torch.eval.judge.score import Figures, Truth, score
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.run import AtlasFiles, RunResult, run, settle_camera
from edgeslam_torch.types import FloatArray

FIRST = "first"
"""Folder of the first flight's run."""
ATLAS = "first.atlas"
NEVER_S = 1e3
"""Stands for a place that is never recognised."""
VIEWS_S = 0.5
"""Time between the views that are compared."""
GRID_PX = 16
"""Distance of the pixels that are compared."""
KNOWN_SHARE, KNOWN_RAD, KNOWN_RATIO = 0.5, np.deg2rad(20.0), 1.5
"""A view is known when this share of it was in one view of the first flight within this angle and ratio of distances,
the limits of keypoint matching."""
SAME_DEPTH = 0.05
"""Relative difference of two depths of one point."""
SAME_UNIT = 0.15
"""The same while a map's scale is estimated."""


def fly_first(source: Recording, folder: Path, config: SlamConfig) -> RunResult:
    """Run the first flight and save its map in ``folder``."""
    settle_camera(source)
    return run(source, folder / FIRST, config, atlas=AtlasFiles(save=folder / ATLAS))


def fly_second(source: Recording, out: Path, folder: Path, config: SlamConfig) -> RunResult:
    """Run the second flight with the map of the first."""
    from edgeslam_torch.atlas.atlas_file import read_atlas

    settle_camera(source)
    return run(source, out, config, atlas=AtlasFiles(load=read_atlas(folder / ATLAS)))


def compared(second: Path, truth: Truth, first: Path, first_truth: Truth) -> Figures:
    """Figures of the second flight beside those of any run.

    Args:
        second: Its run.
        truth: What it is compared with.
        first: Run of the first flight.
        first_truth: The same of that one.

    Returns:
        ``placed_after_s`` until the first frame in the map of the first flight, ``placed`` share of frames in it,
        ``metres_off`` absolute log of the ratio of the true lengths of the two flights' units by their ways,
        ``metres_off_depth`` by depth maps; ``known_after_s`` until the first view that the first flight knew, and
        ``placed_late_s`` from then on, 0 when it never came.
    """
    summary: dict[str, Any] = read_mapping(second / "summary.json", "JSON", EvaluationError)
    found = summary["atlas"]
    after = found["found_after_s"]
    scales = [score(run, its)[0].get("scale_sim3") for run, its in ((first, first_truth), (second, truth))]
    known = [s for s in scales if s]
    return {
        "placed_after_s": NEVER_S if after is None else after,
        "placed": found["frames_placed"] / max(summary["frames"], 1),
        "metres_off": abs(math.log(known[1] / known[0])) if len(known) == 2 else None,
        **_by_depth_maps(open_run(second), truth, open_run(first), first_truth, NEVER_S if after is None else after),
    }


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
    rows = [row for k, row in enumerate(inside) if k == 0 or _ticks(maps.stamps_s[inside[[k - 1, k]]], stamps[0])]
    T_w_c, known = interpolate(truth, maps.stamps_s[rows])
    views = []
    for row, T, is_known in zip(rows, T_w_c, known, strict=True):
        stamp = float(maps.stamps_s[row])
        run_pose = run.trajectory.T_w_c[int(np.abs(stamps - stamp).argmin())]
        if is_known:
            view = View(camera, T @ maps.T_c_d, maps.read(int(row), depth.camera), se3.inverse(maps.T_c_d), run_pose)
            views.append((stamp, view))
    return views


def _ticks(stamps_s: FloatArray, begin_s: float) -> bool:
    """Whether another period has begun between two stamps."""
    before, after = np.floor((stamps_s - begin_s) / VIEWS_S + 1e-6)
    return bool(after > before)


def known_after_s(first: list[View], second: list[tuple[float, View]], begin_s: float) -> float:
    """Time until a view of the second flight is known; infinite when none is."""
    for stamp_s, view in second:
        p_w = view.grid()
        if any(earlier.covers(p_w, view.T_w_c[:3, 3]).mean() >= KNOWN_SHARE for earlier in first if len(p_w)):
            return max(0.0, stamp_s - begin_s)
    return math.inf


def metre_by_depth(views: list[View], p_w: FloatArray) -> float | None:
    """True metres per unit of a run's map points ``(P, 3)``, by the depth maps in which they are seen."""
    logs = []
    for view in views:
        p_c = se3.transform(view.T_d_c @ se3.inverse(view.T_run_w_c), p_w)
        depth = view.depths_at(p_c)
        ratio = np.log(depth / np.where(p_c[:, 2] > 0, p_c[:, 2], np.nan))
        logs.append(ratio[np.abs(ratio) <= SAME_UNIT])  # the others are hidden, or a map's error
    together = np.concatenate(logs) if logs else np.zeros(0)
    return math.exp(float(np.median(together))) if len(together) else None


def _by_depth_maps(second: RunFolder, truth: Truth, first: RunFolder, first_truth: Truth, after_s: float) -> Figures:
    """Figures that need depth maps of both flights; empty without."""
    if truth.poses is None or first_truth.poses is None:
        return {}
    there, here = views_of(first, first_truth.poses), views_of(second, truth.poses)
    if not there or not here:
        return {}
    known_s = known_after_s([view for _, view in there], here, float(second.trajectory.stamps_s[0]))
    metres = []
    for flown, views in ((first, there), (second, here)):
        cloud = flown.cloud("anchors.ply")
        points = np.zeros((0, 3)) if cloud is None else cloud.p_w.astype(np.float64)
        metres.append(metre_by_depth([view for _, view in views], points))
    both = [m for m in metres if m is not None]
    return {
        "known_after_s": known_s,
        "placed_late_s": max(0.0, after_s - known_s) if math.isfinite(known_s) else 0.0,
        "metres_off_depth": abs(math.log(both[1] / both[0])) if len(both) == 2 else None,
    }
