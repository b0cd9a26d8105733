"""What telemetry says of a camera's headings at some moments, as a Gaussian with everything unknown marginalised.

A drone's yaw is an integrated gyroscope: right from one keyframe to the next, and unknown as a whole. Its errors are
added up from what they are: whole degrees; a rate of drift, the same for the flight; a share of each turn, by the
gyroscope's and the camera's scale; the video's delay, which errs with the rate of the turn; and the offset between the
map's axes and those of power-on.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.displacement import DELAY_S, TelemetryModel
from edgeslam_torch.types import FloatArray, IntArray

HEADING_RAD = math.radians(0.5)
"""Error of one heading: whole degrees, and a camera's mount that is off in a turn."""
DRIFT_RAD_S = math.radians(0.02)
"""Standard deviation of the rate at which a gyroscope drifts: a degree in a minute."""
TURN_SHARE = 0.005
"""Standard deviation of a turn, relative: a gyroscope's scale and a focal length are known to half a percent."""
_OFFSET_RAD = 1.0
_RATE_S = 0.1
"""Time over which the rate of a turn is taken."""


@dataclass(frozen=True, slots=True)
class Headings:
    """Attitudes of some pictures, whose turn about the vertical is to be believed."""

    frame: IntArray
    """``(U,)`` which of the frames asked about."""
    R_c_m: FloatArray
    """``(U, 3, 3)`` map to camera, up to a common turn about the vertical."""
    up_m: FloatArray
    """``(3,)`` the vertical in the map."""
    information: FloatArray
    """``(U, U)`` of the errors about it [1/rad^2]; a common turn is not determined."""


def headings(model: TelemetryModel, stamps_s: FloatArray) -> Headings | None:
    """Headings of frames at increasing ``stamps_s`` ``(K,)``; None where no two are told, or no metres are known."""
    at_s = stamps_s - model.delay_s
    told = model.knows_metres and model.attitude and model.track.has_attitude
    frame = np.flatnonzero(model.track.covered(at_s, at_s)) if told else np.zeros(0, dtype=np.int64)
    if len(frame) < 2:
        return None
    t = at_s[frame]
    R_b_w = np.swapaxes(model.track.attitude(t), 1, 2)
    covariance = HEADING_RAD**2 * np.eye(len(t)) + sum(np.outer(error, error) for error in _common(model, t))
    R_c_m = model.T_b_c[:3, :3].T @ R_b_w @ model.R_w_m
    return Headings(frame, R_c_m, model.R_w_m[2], np.linalg.inv(covariance))


def _common(model: TelemetryModel, t: FloatArray) -> tuple[FloatArray, ...]:
    """Errors of headings at ``t`` ``(U,)`` per standard deviation of what is common to all: ``(U,)`` each [rad]."""
    turned = model.track.yaw(np.stack([t - 0.5 * _RATE_S, t, t + 0.5 * _RATE_S]))
    yaw, rate = turned[1], (turned[2] - turned[0]) / _RATE_S
    late_s = min(model.delay_sigma_s, DELAY_S)
    return np.full(len(t), _OFFSET_RAD), DRIFT_RAD_S * (t - t[0]), TURN_SHARE * (yaw - yaw[0]), late_s * rate
