"""Edge map against the measured world: accuracy of its points, and completeness of the edges.

The measured world is a fused cloud and the 3-D edge points of a data set's depth maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import nearest
from edgeslam_torch.eval.inputs.dataset import EvalDataset, interpolate, open_dataset
from edgeslam_torch.eval.metrics.align import Alignment, umeyama
from edgeslam_torch.eval.metrics.depth_error import edge_mask
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.readers.sequence import DepthMaps, register_depth
from edgeslam_torch.types import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

MAX_DEPTH_M = 5.0
"""A Kinect's noise grows with the square of the distance: 7 cm at 5 m (Khoshelham & Elberink 2012)."""
MAX_EDGE_DEPTH_M = 4.0
"""Maximum depth of reference edges: beyond it, measured depth is worse than the 6 cm tolerance."""
_STRIDE = 2
"""Every second pixel of both directions: 8 mm at 2 m."""
_VOXEL_M, _EDGE_VOXEL_M = 0.005, 0.015
"""The fused cloud keeps one point of each cube of the first size; edge points in one cube of the second are one."""
_EDGE_MAPS = 3
"""Number of depth maps that must place a reference edge in the same cube, to exclude flicker and noisy depth."""
_EDGE_FRAMES, _SINGLE_FRAMES = 40, 30
"""Depth maps used for reference edges, and to judge a point one by one, evenly spaced over the sequence."""
_HIDDEN_M = 0.1
"""A point this far behind a depth map's surface is hidden there and cannot be compared with that map."""
_HOLE_PX, _NEAR_PX = 4, 2
"""Distance of reference edges from unmeasured pixels, where depth is unreliable, at least; and that within which the
nearest depth is an edge's: it belongs to the occluding side."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTruth:
    """Measured surface and edges in the ground truth's world frame."""

    tree: "cKDTree"
    """Over the fused cloud ``(P, 3)`` [m]."""
    edges_w: FloatArray
    """``(Q, 3)`` edge points [m]."""
    depth_m: FloatArray
    """``(D, H/2, W/2)`` depth maps, 0 where nothing was measured."""
    T_d_w: FloatArray
    """``(D, 4, 4)`` world to depth camera."""
    camera: Camera
    """Depth camera at the maps' reduced size, without distortion."""

    def observed(self, p_w: FloatArray) -> np.ndarray:
        """Which points ``(N, 3)`` fall on a measured pixel of at least one depth map, at whatever depth.

        A point behind the measured surface counts as observed: it may be an error, and is judged as one.
        """
        seen = np.zeros(len(p_w), dtype=bool)
        for depth, T in zip(self.depth_m, self.T_d_w, strict=True):
            rest = np.flatnonzero(~seen)
            if len(rest) == 0:
                break
            index, _ = self._readings(depth, se3.transform(T, p_w[rest]))
            seen[rest[index]] = True
        return seen

    def single_map_distance(self, p_w: FloatArray) -> FloatArray:
        """Distance ``(N,)`` [m] of points to the surface of one depth map: the median over the maps that see them.

        The nearest of *all* maps' points flatters: a hundred noisy maps fill a shell around every surface, and a
        point with 1 cm error finds a neighbour in it. One map is one layer. A map sees a point that falls on a
        measured pixel and is not hidden behind it; a point hidden in all maps gets its least distance to any.
        NaN where no map measured anything.
        """
        step = max(1, len(self.depth_m) // _SINGLE_FRAMES)
        found = np.full((len(p_w), len(self.depth_m[::step])), np.nan, dtype=np.float32)
        hidden = np.full(len(p_w), np.inf, dtype=np.float32)
        for k, (depth, T) in enumerate(zip(self.depth_m[::step], self.T_d_w[::step], strict=True)):
            p_d = se3.transform(T, p_w)
            index, reading = self._readings(depth, p_d)
            distance = search_tree(_points(depth, self.camera, np.eye(4))).query(p_d[index])[0].astype(np.float32)
            behind = p_d[index, 2] > reading + _HIDDEN_M
            found[index[~behind], k] = distance[~behind]
            hidden[index[behind]] = np.minimum(hidden[index[behind]], distance[behind])
        out = np.where(np.isfinite(hidden), hidden, np.float32(np.nan))
        some = ~np.isnan(found).all(axis=1)
        out[some] = np.nanmedian(found[some], axis=1)
        return out

    def _readings(self, depth: FloatArray, p_d: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Which points ``(N, 3)`` of the depth camera's frame fall on a measured pixel, and the depth there."""
        index = np.flatnonzero(p_d[:, 2] > 0.1)
        uv = np.rint(self.camera.project(p_d[index])).astype(np.int64)
        inside = ((uv >= 0) & (uv < depth.shape[::-1])).all(axis=1)
        index, uv = index[inside], uv[inside]
        reading = depth[uv[:, 1], uv[:, 0]]
        return index[reading > 0], reading[reading > 0]


@lru_cache(maxsize=2)
def surface_truth(folder: Path) -> SurfaceTruth:
    """Measured surface of a data set; kept for the next run on the same one.

    Raises:
        EvaluationError: If the data set has no depth maps with known poses.
    """
    return build_surface(open_dataset(folder))


def build_surface(dataset: EvalDataset) -> SurfaceTruth:
    """Fuse a data set's depth maps with its true poses (see `surface_truth`)."""
    measured, colour = dataset.depth, dataset.camera
    if measured is None or colour is None or len(measured.paths) == 0:
        raise EvaluationError(f"{dataset.folder}: no depth maps (depth.txt and a camera.yaml are needed)")
    T_w_d, known = interpolate(dataset.truth, measured.stamps_s)
    index = np.flatnonzero(known)
    if len(index) == 0:
        raise EvaluationError(f"{dataset.folder}: no depth map has a true pose at its time")
    edge_index = set(index[:: max(1, len(index) // _EDGE_FRAMES)].tolist())
    camera = measured.taken_by(colour)
    # Pixels are taken, not averaged: sub-pixel phase 0 of every stride, hence the plain division below.
    fx, fy, cx, cy = (value / _STRIDE for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    small = Camera(camera.width // _STRIDE, camera.height // _STRIDE, fx, fy, cx, cy, source=camera.source)
    clouds, edges, maps = [], [], []
    for i in index:
        depth = measured.read(int(i), colour)
        depth[depth > MAX_DEPTH_M] = 0.0
        maps.append(depth[::_STRIDE, ::_STRIDE].copy())
        clouds.append(_thinned(_points(maps[-1], small, T_w_d[i])))
        if i in edge_index:
            edges.append(_edge_points(dataset, measured, depth, int(i)))
    tree = search_tree(_thinned(np.concatenate(clouds)))
    return SurfaceTruth(tree, _agreed(edges), np.stack(maps), se3.inverse(T_w_d[index]), small)


def search_tree(p: FloatArray) -> "cKDTree":
    """For the nearest of points ``(N, 3)``; unbalanced, as building it costs more than the dozen times it is asked."""
    from scipy.spatial import cKDTree  # 0.7 s to import, which a run without depth maps does not need

    return cKDTree(p, balanced_tree=False, compact_nodes=False)


def _points(depth: FloatArray, camera: Camera, T_w_d: FloatArray) -> FloatArray:
    v, u = np.nonzero(depth)
    p = camera.back_project(np.stack([u, v], axis=1).astype(np.float64), depth[v, u])
    return se3.transform(T_w_d, p).astype(np.float32)


def _thinned(p: FloatArray) -> FloatArray:
    """One point of each cube; the first in order."""
    return p[np.sort(np.unique(_cells(p, _VOXEL_M), return_index=True)[1])]


def _cells(p: FloatArray, voxel_m: float) -> np.ndarray:
    """One integer a cube."""
    cell = np.floor(p / voxel_m).astype(np.int64)
    return (cell[:, 0] * 1_000_003 + cell[:, 1]) * 1_000_003 + cell[:, 2]


def _agreed(edges: list[FloatArray]) -> FloatArray:
    """Mean of the edge points in each cube that enough maps agree on, ``(Q, 3)``."""
    p = np.concatenate(edges)
    if len(p) == 0:
        return p
    frame = np.repeat(np.arange(len(edges)), [len(e) for e in edges])
    _, cell = np.unique(_cells(p, _EDGE_VOXEL_M), return_inverse=True)
    maps = np.bincount(np.unique(cell * len(edges) + frame) // len(edges))
    mean = np.stack([np.bincount(cell, weights=axis) for axis in p.T], axis=1) / np.bincount(cell)[:, None]
    return mean[maps >= min(_EDGE_MAPS, len(edges))].astype(np.float32)


def _edge_points(dataset: EvalDataset, measured: DepthMaps, depth: FloatArray, index: int) -> FloatArray:
    """World points ``(N, 3)`` of the colour image's edges that have a measured depth."""
    empty = np.zeros((0, 3), dtype=np.float32)
    if dataset.camera is None or len(dataset.frame_stamps_s) == 0:
        return empty
    k = int(nearest(dataset.frame_stamps_s, measured.stamps_s[index : index + 1])[0])
    T_w_image, known = interpolate(dataset.truth, dataset.frame_stamps_s[k : k + 1])
    image = pixels_or_none(dataset.image_paths[k], cv2.IMREAD_GRAYSCALE)
    if abs(dataset.frame_stamps_s[k] - measured.stamps_s[index]) > 0.02 or not known[0] or image is None:
        return empty
    T_c_d, camera = measured.T_c_d, dataset.camera
    if not measured.is_registered:
        depth = register_depth(depth, measured.taken_by(camera), T_c_d, camera)
    canny = edge_mask(np.asarray(camera.undistort_image(image), np.uint8))
    hole, near = (np.ones((2 * px + 1,) * 2, np.uint8) for px in (_HOLE_PX, _NEAR_PX))
    solid = cv2.erode((depth > 0).astype(np.uint8), hole, borderValue=0) > 0
    nearest_m = cv2.erode(np.where(depth > 0, depth, np.float32(1e3)), near)
    v, u = np.nonzero(canny & solid & (nearest_m < MAX_EDGE_DEPTH_M))
    z = np.asarray(nearest_m, dtype=np.float64)[v, u]
    p_c = camera.back_project(np.stack([u, v], axis=1).astype(np.float64), z)
    # The truth is the pose of the depth camera where the two differ.
    return se3.transform(T_w_image[0] @ se3.inverse(T_c_d), p_c).astype(np.float32)


THRESHOLDS_M = (0.02, 0.06, 0.10)
"""Distances at which accuracy, completeness and F-score are given."""

_MAX_POINTS = 200_000
"""Larger maps are judged on this many of their points, drawn with a fixed seed."""

_MAX_SINGLE = 20_000
"""Points judged against single depth maps."""

_MAX_ICP = 8000
_ICP_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class MapScore:
    """Accuracy and completeness of a map."""

    points: int
    """Points in the map."""
    judged_share: float
    """Share of the points that fall on a measured pixel of some depth map; the others are not judged."""
    median_m: float
    """Median distance of a judged point to the nearest point of all depth maps fused."""
    single_map_median_m: float
    """The same against one depth map at a time (`SurfaceTruth.single_map_distance`): the stricter figure."""
    own_alignment_median_m: float
    """The first after a Sim(3) of the map itself (trimmed ICP): the map's shape, without the trajectory's error."""
    mean_m: float
    p90_m: float
    accuracy: dict[float, float]
    """Share of the judged points nearer than each threshold [m]."""
    truth_edges: int
    """Ground-truth edge points (1.5 cm apart, agreed on by several depth maps)."""
    completeness: dict[float, float]
    """Share of the ground-truth edge points with a map point nearer than each threshold [m]."""
    f_score: dict[float, float]
    """Harmonic mean of the two."""


def score_map(
    p_w: FloatArray, alignment: Alignment, truth: SurfaceTruth, thresholds_m: Sequence[float] = THRESHOLDS_M
) -> MapScore:
    """Judge map points ``(P, 3)``, in the trajectory's world, after the trajectory's own alignment.

    The map gets no alignment of its own: an error of the trajectory is an error of the map.

    Raises:
        EvaluationError: If the map is empty or none of it is where depth was measured.
    """
    p: FloatArray = np.asarray(p_w, dtype=np.float64)
    p = p[np.isfinite(p).all(axis=1)]
    if len(p) == 0:
        raise EvaluationError("the map holds no finite point")
    if len(p) > _MAX_POINTS:
        p = p[np.random.default_rng(0).choice(len(p), _MAX_POINTS, replace=False)]
    p = alignment.points(p)
    seen = truth.observed(p)
    if not seen.any():
        raise EvaluationError("no map point falls into a measured depth map: wrong trajectory or data set?")
    distance, _ = truth.tree.query(p[seen])
    single = truth.single_map_distance(p[seen][:: max(1, int(seen.sum()) // _MAX_SINGLE)])
    accuracy = {t: float(np.mean(distance <= t)) for t in thresholds_m}
    completeness, f_score = {}, {}
    if len(truth.edges_w):
        tree = search_tree(p)
        gap, _ = tree.query(truth.edges_w, distance_upper_bound=1.01 * max(thresholds_m))
        completeness = {t: float(np.mean(gap <= t)) for t in thresholds_m}
        sums = {t: accuracy[t] + completeness[t] for t in thresholds_m}
        f_score = {t: 2.0 * accuracy[t] * completeness[t] / both if both > 0 else 0.0 for t, both in sums.items()}
    return MapScore(
        points=len(p_w),
        judged_share=float(seen.mean()),
        median_m=float(np.median(distance)),
        single_map_median_m=float(np.nanmedian(single)) if np.isfinite(single).any() else float("nan"),
        own_alignment_median_m=_median_after_icp(p[seen], truth.tree),
        mean_m=float(np.mean(distance)),
        p90_m=float(np.quantile(distance, 0.9)),
        accuracy=accuracy,
        truth_edges=len(truth.edges_w),
        completeness=completeness,
        f_score=f_score,
    )


def _median_after_icp(p: FloatArray, tree: "cKDTree") -> float:
    """Median distance of points ``(P, 3)`` to the tree's after aligning the nearer 70 % of them to it, ten times."""
    p = p[:: max(1, len(p) // _MAX_ICP)]
    if len(p) < 10:
        return float("nan")
    for _ in range(_ICP_ROUNDS):
        distance, index = tree.query(p)
        near = distance <= np.quantile(distance, 0.7)
        try:
            p = umeyama(p[near], tree.data[index[near]]).points(p)
        except EvaluationError:  # all in one place: no shape to align
            return float("nan")
    return float(np.median(tree.query(p)[0]))
