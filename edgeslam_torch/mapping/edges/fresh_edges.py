"""Edges of the newest image, measured at once against existing keyframes, for obstacle avoidance.

`EdgeMap` measures a keyframe's edges after others have followed and keeps those that two of them agree on: two seconds
after the image, too late for an obstacle. Edges of a single image are less reliable: of those that agree with two
views, nine of ten have a depth error below a fifth. A purely rotating camera yields none.
"""

import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.mapping.edges.edge_depth import StereoView, measure_edge_depth
from edgeslam_torch.types import Edges, FloatArray

MOST = 800
"""Maximum number of edge pixels of an image."""
SIGMA_LOG = 0.1
"""Maximum standard deviation of the logarithm of a depth."""
_TARGETS = 4
_BASELINE = 0.03, 0.19
"""Minimum and maximum baseline relative to the geometric mean of the searched depths: 0.04 and 0.25 m for a search from
0.3 to 6 m."""
_HYPOTHESES = 64
"""Number of hypotheses of a search over all depths: from 0.3 m the segment is a hundred pixels long over a baseline of
a tenth of the depth."""


def measure_fresh_edges(
    frame: StereoView, edges: Edges, around: list[StereoView], nearest: float, farthest: float, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Depth of an image's edges by stereo with neighbouring views, between two bounds.

    Args:
        frame: The image.
        edges: Its edges.
        around: Other views of the same place.
        nearest: Minimum searched depth, in the unit of the poses.
        farthest: Maximum searched depth.
        camera: Intrinsics of all views.

    Returns:
        Pixels ``(N, 2)`` and z-depths ``(N,)`` of the measured edges, in the unit of the poses.
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
    """Views whose baseline is within `_BASELINE`, the nearest first."""
    baseline = np.array([np.linalg.norm(_centre_w(view) - _centre_w(frame)) for view in around]) / depth
    fit = [i for i in np.argsort(baseline) if _BASELINE[0] < baseline[i] < _BASELINE[1]]
    return [around[i] for i in fit[:_TARGETS]]


def _centre_w(view: StereoView) -> FloatArray:
    return -view.T_c_w[:3, :3].T @ view.T_c_w[:3, 3]
