"""Headings by telemetry as a Gaussian with nuisance parameters marginalised.

A drone's yaw is an integrated gyroscope: accurate between keyframes, with an unknown offset. Its error model:
quantisation to whole degrees; a drift rate, constant over the flight; scale factors of gyroscope and camera; the
video's delay times the yaw rate; and the offset between the map's axes and those of power-on.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.noise import DELAY_S, HEADING_DRIFT_RAD_S, HEADING_RAD, TURN_SHARE
from edgeslam_torch.types import FloatArray, IntArray

_OFFSET_RAD = 1.0
_RATE_S = 0.1
"""Time over which the yaw rate is computed."""


@dataclass(frozen=True, slots=True)
class Headings:
    """Headings of some frames."""

    frame: IntArray
    """``(U,)`` indices of the frames."""
    R_c_m: FloatArray
    """``(U, 3, 3)`` map to camera, up to a common rotation about the vertical."""
    up_m: FloatArray
    """``(3,)`` the vertical in the map."""
    information: FloatArray
    """``(U, U)`` of the heading errors [1/rad^2]; a common rotation is not determined."""


def headings(model: TelemetryModel, stamps_s: FloatArray) -> Headings | None:
    """Headings of frames at increasing ``stamps_s`` ``(K,)``; None for fewer than two, or without metric scale."""
    at_s = stamps_s - model.delay_s
    measured = model.knows_metres and model.attitude and model.track.has_attitude
    frame = np.flatnonzero(model.track.covered(at_s, at_s)) if measured else np.zeros(0, dtype=np.int64)
    if len(frame) < 2:
        return None
    t = at_s[frame]
    R_b_w = np.swapaxes(model.track.attitude(t), 1, 2)
    covariance = HEADING_RAD**2 * np.eye(len(t)) + sum(np.outer(error, error) for error in _common(model, t))
    R_c_m = model.T_b_c[:3, :3].T @ R_b_w @ model.R_w_m
    return Headings(frame, R_c_m, model.R_w_m[2], np.linalg.inv(covariance))


def _common(model: TelemetryModel, t: FloatArray) -> tuple[FloatArray, ...]:
    """Heading errors at ``t`` ``(U,)`` per standard deviation of each common parameter: ``(U,)`` each [rad]."""
    turned = model.track.yaw(np.stack([t - 0.5 * _RATE_S, t, t + 0.5 * _RATE_S]))
    yaw, rate = turned[1], (turned[2] - turned[0]) / _RATE_S
    late_s = min(model.delay_sigma_s, DELAY_S)
    return np.full(len(t), _OFFSET_RAD), HEADING_DRIFT_RAD_S * (t - t[0]), TURN_SHARE * (yaw - yaw[0]), late_s * rate
