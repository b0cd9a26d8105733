"""What is known of a frame's pose before its image: by the motion so far, and by the drone's attitude."""

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

HELD_RAD = 5e-5
"""Standard deviation that holds a direction against hundreds of corners: together they tell it to .01 px. What all of
them say alike, on guessed depths, is no better for their number."""
DENIED_RAD = math.radians(3.0)
"""Turn that whole degrees do not explain: three readings' worst, where tracked poses stay within one."""
NO_WORSE = 0.9
"""Share of the inliers that an upright pose must keep of a free one's: where the images contradict it they say so by
as many. A climb that is taken for a turn has as many either way."""


@dataclass(frozen=True, slots=True)
class Vertical:
    """The map's z axis as the drone's attitude has it."""

    up_c: FloatArray
    """``(3,)`` in the camera's axes."""
    doubt_rad: float
    """How far it may be off, where the moment is not known: it turned by so much around it."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """The camera's rotation as the drone's attitude has it, by the map of the last seconds (docs/decisions/0119)."""

    R_c_w: FloatArray
    """``(3, 3)`` map to camera."""
    doubt_rad: float
    """How far it may be off, where the moment is not known: it turned by so much around it."""

    def denies(self, T_c_w: FloatArray) -> bool:
        """Whether a pose ``(4, 4)`` has turned as the drone has not."""
        cosine = 0.5 * (float(np.sum(self.R_c_w * T_c_w[:3, :3])) - 1.0)
        return math.acos(min(max(cosine, -1.0), 1.0)) > DENIED_RAD + self.doubt_rad

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` with this rotation, its centre where it is."""
        T = np.eye(4)
        T[:3, :3] = self.R_c_w
        T[:3, 3] = self.R_c_w @ T_c_w[:3, :3].T @ T_c_w[:3, 3]
        return T


@dataclass(frozen=True, slots=True)
class Expectation:
    """What is known of one pose."""

    by_motion: PosePrior
    """Counts where anchors rest on guessed depths."""
    vertical: Vertical | None = None
    """Decides roll and pitch in a young map; None where it is not asked."""


def levelled(expected: PosePrior, vertical: Vertical) -> PosePrior:
    """An expected pose with the drone's roll and pitch; its centre and its turn about the vertical stay."""
    up, up_c = expected.T_c_w[:3, 2], vertical.up_c
    axis = np.cross(up, up_c)
    sine, cosine = float(np.linalg.norm(axis)), float(up @ up_c)
    turn = se3.exp(np.concatenate([np.zeros(3), axis * (math.atan2(sine, cosine) / max(sine, 1e-12))]))
    about = np.outer(up_c, up_c)
    information = expected.information.copy()
    level = (np.eye(3) - about) / math.hypot(HELD_RAD, vertical.doubt_rad) ** 2
    information[3:, 3:] = about @ information[3:, 3:] @ about + level
    return PosePrior(expected.pose, turn @ expected.T_c_w, information)


def pose_on_anchors(
    anchors: Anchors,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    T_c_w: FloatArray,
    camera: Camera,
    expected: Expectation | None,
    config: PoseConfig,
) -> PoseResult:
    """Robust pose of a frame that sees anchors ``(N,)`` at pixels ``(N, 2)``; upright if its image allows it.

    Args:
        anchors: Of the map.
        anchor: Their ids ``(N,)``.
        uv: Undistorted pixels ``(N, 2)``.
        inv_sigma: ``(N,)`` inverse standard deviations [1/px].
        T_c_w: Pose to begin from ``(4, 4)``.
        camera: Intrinsics.
        expected: What is known before the image.
        config: Of the solver.
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
    if expected.vertical is None:
        return free
    by_motion = expected.by_motion if counts else replace(expected.by_motion, information=np.zeros((6, 6)))
    upright = refined(levelled(by_motion, expected.vertical))
    if upright.inliers.sum() < NO_WORSE * free.inliers.sum():
        return free
    # Attitude comes in whole degrees: holding it made the pose no surer than the image is.
    return replace(upright, covariance=free.covariance)
