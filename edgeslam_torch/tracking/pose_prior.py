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
HELD_SHARE = 0.02
"""Standard deviation that holds a centre, as a share of its doubt: hundreds of corners tell it to a tenth."""
DENIED_SHARE = 1.25
"""Share of its doubt at which a centre is denied: more than one that is held at it."""
NO_WORSE = 0.9
"""Share of the inliers that a pose which telemetry holds must keep of a free one's: where the images contradict it they
say so by as many. A climb that is taken for a turn has as many either way."""


@dataclass(frozen=True, slots=True)
class Vertical:
    """The map's z axis as the drone's attitude has it."""

    up_c: FloatArray
    """``(3,)`` in the camera's axes."""
    doubt_rad: float
    """How far it may be off, where the moment is not known: it turned by so much around it."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """The camera's rotation as the drone's attitude has it, by the map of the last seconds.

    It moves no pose by itself (docs/decisions/17-images-decide.md).
    """

    R_c_w: FloatArray
    """``(3, 3)`` map to camera."""
    doubt_rad: float
    """How far it may be off, where the moment is not known: it turned by so much around it."""

    def is_outlier(self, T_c_w: FloatArray) -> bool:
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
class Place:
    """Where the drone's sensors carry the camera, by the map of the last seconds."""

    R_w_m: FloatArray
    """``(3, 3)`` map to the axes of the drone's world."""
    centre: FloatArray
    """``(3,)`` of the camera in them [map units]."""
    doubt: FloatArray
    """``(3,)`` how far it may be off along each [map units]."""

    def beyond(self, T_c_w: FloatArray) -> FloatArray:
        """How far ``(3,)`` the centre of a pose ``(4, 4)`` is from what is not in doubt, along each axis."""
        off = self._off(T_c_w)
        return off - np.clip(off, -self.doubt, self.doubt)

    def is_outlier(self, T_c_w: FloatArray) -> bool:
        """Whether a pose ``(4, 4)`` has gone where the drone has not, by more than `held` leaves open."""
        return bool((np.abs(self._off(T_c_w)) > DENIED_SHARE * self.doubt).any())

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` with its centre where the drone is, along the axes along which that is not in doubt."""
        return self._moved(T_c_w, np.where(self.beyond(T_c_w) != 0, self._off(T_c_w), 0.0))

    def held(self, T_c_w: FloatArray, start: PosePrior) -> PosePrior:
        """A prior that keeps a pose from leaving it along the axes along which it has left."""
        axes, doubt = self._left(T_c_w)
        information = start.information.copy()
        information[:3, :3] += (axes / (HELD_SHARE * doubt) ** 2) @ axes.T
        return PosePrior(start.pose, self._moved(T_c_w, self.beyond(T_c_w)), information)

    def unsure(self, T_c_w: FloatArray) -> FloatArray:
        """Covariance ``(6, 6)`` that is added to a pose held instead of one that has left: all of the doubt."""
        axes, doubt = self._left(T_c_w)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = (axes * doubt**2) @ axes.T
        return covariance

    def _left(self, T_c_w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Axes ``(3, A)`` in the camera along which a pose has left, and the doubt along each ``(A,)``."""
        left = self.beyond(T_c_w) != 0
        return T_c_w[:3, :3] @ self.R_w_m.T[:, left], self.doubt[left]

    def _off(self, T_c_w: FloatArray) -> FloatArray:
        return -self.R_w_m @ T_c_w[:3, :3].T @ T_c_w[:3, 3] - self.centre

    def _moved(self, T_c_w: FloatArray, by: FloatArray) -> FloatArray:
        """A pose whose centre is moved back by ``(3,)`` along the axes; its rotation stays."""
        T = T_c_w.copy()
        T[:3, 3] += T_c_w[:3, :3] @ self.R_w_m.T @ by
        return T


@dataclass(frozen=True, slots=True)
class SensorPrior:
    """What the drone's sensors tell of a frame's pose, at least one of the two."""

    attitude: Attitude | None = None
    place: Place | None = None

    def is_outlier(self, T_c_w: FloatArray) -> bool:
        """Whether a pose ``(4, 4)`` has moved as the drone has not."""
        return any(told is not None and told.is_outlier(T_c_w) for told in (self.attitude, self.place))

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` turned as the drone is, and brought to where it may be."""
        turned = T_c_w if self.attitude is None else self.attitude.applied_to(T_c_w)
        return turned if self.place is None else self.place.applied_to(turned)


@dataclass(frozen=True, slots=True)
class TrackingPrior:
    """What is known of one pose."""

    by_motion: PosePrior
    """Counts where anchors rest on guessed depths."""
    vertical: Vertical | None = None
    """Decides roll and pitch in a young map; None where it is not asked."""
    place: Place | None = None
    """Keeps what the images hardly tell within it; None where telemetry tells none."""


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
    expected: TrackingPrior | None,
    config: PoseConfig,
) -> PoseResult:
    """Robust pose of a frame that sees anchors ``(N,)`` at pixels ``(N, 2)``; where the drone has it if images allow.

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
    by_motion = expected.by_motion if counts else replace(expected.by_motion, information=np.zeros((6, 6)))
    place = expected.place
    if expected.vertical is not None:
        held = refined(levelled(by_motion, expected.vertical))
        # Attitude comes in whole degrees: holding it made the pose no surer than the image is.
        covariance = free.covariance
    elif place is not None and free.inliers.any() and place.beyond(free.T_c_w).any():
        held = refined(place.held(free.T_c_w, by_motion))
        covariance = free.covariance + place.unsure(free.T_c_w)
    else:
        return free
    return free if held.inliers.sum() < NO_WORSE * free.inliers.sum() else replace(held, covariance=covariance)
