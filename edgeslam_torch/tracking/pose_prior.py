"""Priors on a frame's pose from the motion model and from the drone's attitude."""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.mapping.prior_anchors import depth_slack_px, mostly_on_priors
from edgeslam_torch.optim.pose_only import PoseConfig, PoseResult, refine_pose
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.types import FloatArray, IntArray

VERTICAL_SIGMA_RAD = 5e-5
"""Standard deviation of the vertical, small enough to outweigh hundreds of corners: on predicted depths their errors
are correlated, and their number does not improve the pose."""
KEPT_SHARE = 0.9
"""Minimum ratio of inliers of a pose constrained by telemetry to those of a free one: fewer inliers mean that images
contradict the constraint. Where images cannot distinguish a climb from a rotation, the numbers are equal."""


@dataclass(frozen=True, slots=True)
class Vertical:
    """The map's z axis from the drone's attitude."""

    up_c: FloatArray
    """``(3,)`` in the camera's axes."""
    doubt_rad: float
    """Maximum error due to the uncertain stamp."""


@dataclass(frozen=True, slots=True)
class TrackingPrior:
    """Prior on one pose."""

    by_motion: PosePrior
    """Used where anchors rest on predicted depths."""
    vertical: Vertical | None = None
    """Constrains roll and pitch in a new map; None where unused."""


def levelled(expected: PosePrior, vertical: Vertical) -> PosePrior:
    """A predicted pose with the drone's roll and pitch; its centre and heading are unchanged."""
    up, up_c = expected.T_c_w[:3, 2], vertical.up_c
    axis = np.cross(up, up_c)
    sine, cosine = float(np.linalg.norm(axis)), float(up @ up_c)
    turn = se3.exp(np.concatenate([np.zeros(3), axis * (math.atan2(sine, cosine) / max(sine, 1e-12))]))
    about = np.outer(up_c, up_c)
    information = expected.information.copy()
    level = (np.eye(3) - about) / math.hypot(VERTICAL_SIGMA_RAD, vertical.doubt_rad) ** 2
    information[3:, 3:] = about @ information[3:, 3:] @ about + level
    return PosePrior(expected.pose, turn @ expected.T_c_w, information)


def pose_on_anchors(
    anchors: Anchors,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    T_c_w: FloatArray,
    camera: Camera,
    expected: TrackingPrior | None,
    config: PoseConfig,
) -> PoseResult:
    """Robust pose of a frame from anchors ``(N,)`` at pixels ``(N, 2)``, levelled by attitude if images allow.

    Args:
        anchors: Anchors of the map.
        anchor: Their ids ``(N,)``.
        uv: Undistorted pixels ``(N, 2)``.
        inv_sigma: ``(N,)`` inverse standard deviations [1/px].
        T_c_w: Initial pose ``(4, 4)``.
        camera: Intrinsics.
        expected: Prior on the pose.
        config: Solver settings.
    """
    slack_px = depth_slack_px(anchors, anchor, T_c_w, camera)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)

    def refined(prior: PosePrior | None) -> PoseResult:
        p_w = anchors.p_w[anchor]
        return refine_pose(T_c_w, p_w, uv, inv_sigma, intrinsics, slack_px=slack_px, prior=prior, config=config)

    if expected is None:
        return refined(None)
    counts = mostly_on_priors(anchors, anchor)
    free = refined(expected.by_motion if counts else None)
    by_motion = expected.by_motion if counts else replace(expected.by_motion, information=np.zeros((6, 6)))
    if expected.vertical is None:
        return free
    bound = refined(levelled(by_motion, expected.vertical))
    if bound.inliers.sum() < KEPT_SHARE * free.inliers.sum():
        return free
    return replace(bound, covariance=free.covariance)  # attitude is in whole degrees and adds no certainty
