"""Depth prior of keypoints before triangulation, from the depth network and the anchors nearby."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.frontend.keypoint_grid import nearest_pixels
from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.relative_depth import InverseFit, fit_inverse
from edgeslam_torch.types import DepthMap, FloatArray

REACH_PX = 40.0
"""Distance at which an anchor's correction of the network's depth has decayed to 1/e."""
NEAREST = 4
"""Number of nearest anchors used per pixel."""

UNKNOWN_DEPTH_LOG = 0.35
"""Standard deviation of log depth without a network; wide enough for a desk and the wall behind it."""

MIN_ANCHORS = 8
"""Minimum number of anchors for a fit."""


@dataclass(frozen=True, slots=True)
class DepthFit:
    """Map units per network metre, from the anchors of one keyframe."""

    log_ratio: float
    sigma_log: float
    """Robust spread of single anchors around the fit."""
    anchors: int

    def log_ratio_at(self, network_m: FloatArray) -> FloatArray:
        """Log of map units per network metre at pixels with the network's depth ``(N,)``: everywhere the same."""
        return np.full(len(network_m), self.log_ratio)


def sample(depth: DepthMap, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Depth [m] and its log sigma at the nearest pixels of ``(N, 2)``; NaN where unknown."""
    height, width = depth.depth_m.shape
    u = np.clip(np.rint(uv[:, 0]), 0, width - 1).astype(np.int64)
    v = np.clip(np.rint(uv[:, 1]), 0, height - 1).astype(np.int64)
    z = depth.depth_m[v, u].astype(np.float64)
    return np.where(z > 0, z, np.nan), depth.sigma_log[v, u].astype(np.float64)


def fit_to_anchors(network_m: FloatArray, anchor_depth: FloatArray) -> DepthFit | None:
    """Robust scale between network depth and anchor depth at the same pixels, both ``(A,)``."""
    usable = np.isfinite(network_m) & (network_m > 0) & (anchor_depth > 0)
    if usable.sum() < MIN_ANCHORS:
        return None
    log_ratio = np.log(anchor_depth[usable] / network_m[usable])
    centre = float(np.median(log_ratio))
    spread = robust_sigma(log_ratio - centre)
    return DepthFit(centre, max(spread, 0.02), int(usable.sum()))


def depth_prior(keyframe: Keyframe, uv: FloatArray, anchors: Anchors) -> tuple[FloatArray, FloatArray]:
    """Expected z-depth [map units] and its log sigma at pixels ``(N, 2)`` of a keyframe, ``(N,)`` each.

    With a depth map: the network's depth in map units by the keyframe's anchors, corrected by those nearby, with at
    least the sigma observed at them, since the network is overconfident in unseen rooms. A relative one gets scale
    and shift from triangulated anchors. Without either: the log depth of the nearest anchors, with a wide sigma.

    Args:
        keyframe: Keyframe with some anchors.
        uv: Undistorted pixels.
        anchors: All anchors.
    """
    observed = keyframe.keypoints_with_anchor()
    p_w = anchors.p_w[keyframe.anchor[observed]]
    z = (p_w @ keyframe.T_c_w[:3, :3].T + keyframe.T_c_w[:3, 3])[:, 2]
    observed, z = observed[z > 0], z[z > 0]
    if len(observed) == 0:
        return np.full(len(uv), np.nan), np.full(len(uv), np.inf)
    anchor_uv = keyframe.features.uv[observed]
    if keyframe.depth is not None:
        network, sigma = sample(keyframe.depth, uv)
        at_anchors, _ = sample(keyframe.depth, anchor_uv)
        fit: DepthFit | InverseFit | None
        if keyframe.depth.is_relative:  # anchors that rest on it would agree with any scale and shift
            measured = ~anchors.from_depth[keyframe.anchor[observed]]
            fit = fit_inverse(at_anchors[measured], z[measured])
            sigma = sigma if fit is None else fit.sigma(network)
        else:
            fit = fit_to_anchors(at_anchors, z)
        if fit is not None:
            error = np.log(z / at_anchors) - fit.log_ratio_at(at_anchors)
            known = np.isfinite(error)
            bend, unexplained = _bend(anchor_uv[known], error[known], uv)
            log_ratio = fit.log_ratio_at(network)
            return network * np.exp(log_ratio + bend), np.hypot(np.maximum(sigma, unexplained), 0.05)
    log_z, _ = _nearby(anchor_uv, np.log(z), uv)
    return np.exp(log_z), np.full(len(uv), UNKNOWN_DEPTH_LOG)


def _bend(anchor_uv: FloatArray, error: FloatArray, uv: FloatArray) -> tuple[FloatArray, float]:
    """Correction of the network's log depth at pixels from its error at the anchors near them.

    Returns:
        The correction ``(N,)``, fading with the distance to the nearest anchor, and the robust spread of the anchors'
        leave-one-out residuals.
    """
    mean, distance = _nearby(anchor_uv, error, uv)
    mean_of_others, to_others = _nearby(anchor_uv, error, anchor_uv, but_itself=True)
    left = error - np.exp(-to_others / REACH_PX) * mean_of_others
    return np.exp(-distance / REACH_PX) * mean, robust_sigma(left)


def _nearby(
    anchor_uv: FloatArray, values: FloatArray, uv: FloatArray, but_itself: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Distance-weighted mean of the values at the four nearest anchors, and the distance [px] to the nearest."""
    distance, nearest = nearest_pixels(anchor_uv, uv, min(NEAREST + but_itself, len(anchor_uv)))
    if but_itself:
        distance, nearest = distance[:, 1:], nearest[:, 1:]
    weight = 1.0 / (distance + 5.0)
    return (weight * values[nearest]).sum(1) / weight.sum(1), distance[:, 0]
