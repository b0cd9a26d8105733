"""Priors on a frame's pose from the motion model and from the drone's sensors."""

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
ROTATION_GATE_RAD = math.radians(3.0)
"""Gate for rotations: the maximum error of three readings in whole degrees; tracked poses are within one degree."""
CENTRE_SIGMA_SHARE = 0.02
"""Standard deviation of a constrained centre, as a share of its maximum error: hundreds of corners reach a tenth."""
CENTRE_GATE_SHARE = 1.25
"""Gate for the centre, as a share of its maximum error; larger than 1, the bound of a constrained centre."""
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
class Attitude:
    """The camera's rotation from the drone's attitude, aligned with the map over the last seconds.

    Used as a gate only; it does not correct poses (docs/decisions/17-images-decide.md).
    """

    R_c_w: FloatArray
    """``(3, 3)`` map to camera."""
    doubt_rad: float
    """Maximum error due to the uncertain stamp."""

    def is_outlier(self, T_c_w: FloatArray) -> bool:
        """Whether the rotation of a pose ``(4, 4)`` is outside the gate."""
        cosine = 0.5 * (float(np.sum(self.R_c_w * T_c_w[:3, :3])) - 1.0)
        return math.acos(min(max(cosine, -1.0), 1.0)) > ROTATION_GATE_RAD + self.doubt_rad

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` with this rotation and its own centre."""
        T = np.eye(4)
        T[:3, :3] = self.R_c_w
        T[:3, 3] = self.R_c_w @ T_c_w[:3, :3].T @ T_c_w[:3, 3]
        return T


@dataclass(frozen=True, slots=True)
class Place:
    """The camera's position from dead reckoning, starting at the poses of the last seconds."""

    R_w_m: FloatArray
    """``(3, 3)`` map to the axes of the drone's world."""
    centre: FloatArray
    """``(3,)`` camera centre in them [map units]."""
    doubt: FloatArray
    """``(3,)`` maximum error along each axis [map units]."""

    def beyond(self, T_c_w: FloatArray) -> FloatArray:
        """Distance ``(3,)`` of the centre of a pose ``(4, 4)`` from the interval, along each axis."""
        off = self._off(T_c_w)
        return off - np.clip(off, -self.doubt, self.doubt)

    def is_outlier(self, T_c_w: FloatArray) -> bool:
        """Whether the centre of a pose ``(4, 4)`` is outside the gate."""
        return bool((np.abs(self._off(T_c_w)) > CENTRE_GATE_SHARE * self.doubt).any())

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` with the dead-reckoned centre along the axes along which it is outside the interval."""
        return self._moved(T_c_w, np.where(self.beyond(T_c_w) != 0, self._off(T_c_w), 0.0))

    def constrained(self, T_c_w: FloatArray, start: PosePrior) -> PosePrior:
        """A prior that constrains a pose to the interval along the axes along which it is outside."""
        axes, doubt = self._left(T_c_w)
        information = start.information.copy()
        information[:3, :3] += (axes / (CENTRE_SIGMA_SHARE * doubt) ** 2) @ axes.T
        return PosePrior(start.pose, self._moved(T_c_w, self.beyond(T_c_w)), information)

    def unsure(self, T_c_w: FloatArray) -> FloatArray:
        """Covariance ``(6, 6)`` to add for a constrained pose: the whole interval along the constrained axes."""
        axes, doubt = self._left(T_c_w)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = (axes * doubt**2) @ axes.T
        return covariance

    def _left(self, T_c_w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Axes ``(3, A)`` in the camera along which a pose is outside, and the maximum error along each ``(A,)``."""
        left = self.beyond(T_c_w) != 0
        return T_c_w[:3, :3] @ self.R_w_m.T[:, left], self.doubt[left]

    def _off(self, T_c_w: FloatArray) -> FloatArray:
        return -self.R_w_m @ T_c_w[:3, :3].T @ T_c_w[:3, 3] - self.centre

    def _moved(self, T_c_w: FloatArray, by: FloatArray) -> FloatArray:
        """A pose with its centre moved by ``(3,)`` along the axes."""
        T = T_c_w.copy()
        T[:3, 3] += T_c_w[:3, :3] @ self.R_w_m.T @ by
        return T


@dataclass(frozen=True, slots=True)
class SensorPrior:
    """Attitude and position of a frame from the drone's sensors, at least one of the two."""

    attitude: Attitude | None = None
    place: Place | None = None

    def is_outlier(self, T_c_w: FloatArray) -> bool:
        """Whether a pose ``(4, 4)`` contradicts either."""
        return any(sensor is not None and sensor.is_outlier(T_c_w) for sensor in (self.attitude, self.place))

    def applied_to(self, T_c_w: FloatArray) -> FloatArray:
        """A pose ``(4, 4)`` with the sensors' rotation and position."""
        turned = T_c_w if self.attitude is None else self.attitude.applied_to(T_c_w)
        return turned if self.place is None else self.place.applied_to(turned)


@dataclass(frozen=True, slots=True)
class TrackingPrior:
    """Prior on one pose."""

    by_motion: PosePrior
    """Used where anchors rest on predicted depths."""
    vertical: Vertical | None = None
    """Constrains roll and pitch in a new map; None where unused."""
    place: Place | None = None
    """Bounds poorly observed translation; None without telemetry."""


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
    """Robust pose of a frame from anchors ``(N,)`` at pixels ``(N, 2)``, constrained by sensors if images allow.

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
    place = expected.place
    if expected.vertical is not None:
        bound = refined(levelled(by_motion, expected.vertical))
        # Attitude is in whole degrees: the constraint does not reduce the covariance.
        covariance = free.covariance
    elif place is not None and free.inliers.any() and place.beyond(free.T_c_w).any():
        bound = refined(place.constrained(free.T_c_w, by_motion))
        covariance = free.covariance + place.unsure(free.T_c_w)
    else:
        return free
    return free if bound.inliers.sum() < KEPT_SHARE * free.inliers.sum() else replace(bound, covariance=covariance)
