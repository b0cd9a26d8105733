"""Edges of the newest picture, measured as soon as it is seen: what stands before a drone now.

`EdgeMap` measures a keyframe's edges when others have followed and keeps what two of them agree on: two seconds after
the picture, which is late for what is in the way. These here are one picture's word, against keyframes that are there
already. Nine of ten that agree with two others are right to a fifth; where the camera has only
turned there is none.
"""

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.mapping.edges.edge_depth import StereoView, measure_edge_depth
from edgeslam_torch.types import Edges, FloatArray

MOST = 800
"""Edge pixels of a picture."""
SIGMA_LOG = 0.1
"""Maximum standard deviation of the logarithm of a depth."""
_TARGETS = 4
_BASELINE = 0.03, 0.19
"""Shortest and longest baseline, of the geometric mean of the depths searched: .04 and .25 m from .3 to 6 m."""
_HYPOTHESES = 64
"""Of a search over all depths, not around a prior: from .3 m on a hundred pixels, over a baseline of a tenth."""


def measure_fresh_edges(
    frame: StereoView, edges: Edges, around: list[StereoView], nearest: float, farthest: float, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Depth of a picture's edges against views around it, wherever it is between two bounds.

    Args:
        frame: The picture.
        edges: Its edges.
        around: Other views of the same place.
        nearest: Least depth that is searched.
        farthest: Greatest depth.
        camera: Intrinsics of all.

    Returns:
        Pixels ``(N, 2)`` and z-depths ``(N,)`` of the edges whose depth the views tell, in the unit of the poses.
    """
    middle, reach = np.sqrt(nearest * farthest), np.log(farthest / nearest) / 5.0
    targets = _targets(frame, around, middle)
    count = len(edges.uv)
    prior, sigma = np.full(count, middle), np.full(count, reach)  # the search spans two and a half sigmas either way
    measured = measure_edge_depth(frame, edges.uv, edges.normal, prior, sigma, targets, camera, _HYPOTHESES)
    depth = 1.0 / measured.inverse_depth
    good = np.isfinite(depth) & (depth > 0) & (measured.sigma * depth < SIGMA_LOG)
    return edges.uv[good], depth[good]


def _targets(frame: StereoView, around: list[StereoView], depth: float) -> list[StereoView]:
    """Those of the views that tell depth and look alike, the nearest first."""
    baseline = np.array([np.linalg.norm(_centre_w(view) - _centre_w(frame)) for view in around]) / depth
    fit = [i for i in np.argsort(baseline) if _BASELINE[0] < baseline[i] < _BASELINE[1]]
    return [around[i] for i in fit[:_TARGETS]]


def _centre_w(view: StereoView) -> FloatArray:
    return -view.T_c_w[:3, :3].T @ view.T_c_w[:3, 3]
