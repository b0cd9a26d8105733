"""Edge map against measured depth: accuracy of its points and completeness of the edges."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.metrics.align import Alignment, umeyama
from edgeslam_torch.eval.metrics.surface import SurfaceTruth, search_tree
from edgeslam_torch.types import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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
        f_score = {t: _harmonic(accuracy[t], completeness[t]) for t in thresholds_m}
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


def _harmonic(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0 else 0.0
