"""Attitude of the drone's SDK: direction of gravity and heading of frames, with covariance.

Roll and pitch err by what acceleration is taken for gravity. Yaw is an integrated gyroscope: accurate between
keyframes, with an unknown offset. Its error model: quantisation to whole degrees; a drift rate, constant over the
flight; scale factors of gyroscope and camera; the video's delay times the yaw rate; and the offset between the map's
axes and those of power-on.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.gate import passes
from edgeslam_torch.geometry.rotations import vectors_from_matrices
from edgeslam_torch.noise import (
    DELAY_S,
    HEADING_DRIFT_RAD_S,
    HEADING_RAD,
    MAP_TURN_RAD,
    TURN_SHARE,
    UP_MEMORY_S,
    UP_RAD,
)
from edgeslam_torch.types import FloatArray, IntArray

_OFFSET_RAD = 1.0
_RATE_S = 0.1
"""Time over which the yaw rate is computed."""
_UNPROVEN_S = 3.0
"""Range of delays to consider before telemetry is validated, as in `comparison`."""
_STEADY_RAD = math.radians(15.0)
"""Maximum lean of a drone that takes off and flies slowly. A hand-held camera rolls by more, and its unvalidated
attitude may have the wrong stamp."""


@dataclass(frozen=True, slots=True)
class UpDirections:
    """Direction of gravity in some frames."""

    frame: IntArray
    """``(U,)`` indices of the frames."""
    up_c: FloatArray
    """``(U, 3)`` unit vectors, camera axes."""
    up_m: FloatArray
    """``(3,)`` the same in map axes."""
    sigma_rad: float
    """Standard deviation per axis of each."""


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

    def passes(self, R_c_m: FloatArray) -> bool:
        """Whether they agree with the frames' rotations ``(U, 3, 3)`` in a map that may be bent; not across a jump of
        yaw."""
        apart = np.swapaxes(self.R_c_m, 1, 2) @ R_c_m
        residual = vectors_from_matrices(apart[0].T @ apart) @ self.up_m
        return passes(residual, np.linalg.inv(self.information) + MAP_TURN_RAD**2 * np.eye(len(residual)))


def up_directions(
    track: TelemetryTrack, at_s: FloatArray, R_b_c: FloatArray, R_w_m: FloatArray, steady_only: bool
) -> UpDirections | None:
    """Gravity in the frames at ``at_s`` ``(K,)`` of telemetry's clock; None without attitude.

    Args:
        track: Telemetry.
        at_s: Times of the frames.
        R_b_c: Camera in the body ``(3, 3)``.
        R_w_m: Map to power-on world ``(3, 3)``.
        steady_only: Only frames in which the drone hardly leans, for any plausible delay.
    """
    use = track.covered(at_s, at_s)
    if steady_only:  # without parallax half a degree of lean looks like motion, and depths diverge
        use &= is_steady(track, at_s)
    frame = np.flatnonzero(use)
    if len(frame) == 0:
        return None
    t = at_s[frame]
    R_w_c = track.attitude(t) @ R_b_c
    # Errors of neighbours are correlated: together they count as one.
    correlated = (np.abs(t[:, None] - t[None]) < 0.5 * UP_MEMORY_S).sum(1)
    return UpDirections(frame, R_w_c[:, 2, :], R_w_m[2], UP_RAD * math.sqrt(float(np.median(correlated))))


def turned(track: TelemetryTrack, from_s: float, to_s: float, R_b_c: FloatArray) -> FloatArray | None:
    """Rotation ``R_c1_c0`` ``(3, 3)`` of the camera between two times of telemetry's clock; None over a gap."""
    ends_s = np.array([from_s, to_s])
    if not track.covered(ends_s[:1], ends_s[1:])[0]:
        return None
    R_w_c = track.attitude(ends_s) @ R_b_c
    return np.asarray(R_w_c[1].T @ R_w_c[0])


def is_steady(track: TelemetryTrack, at_s: FloatArray) -> NDArray[np.bool_]:
    """Whether the drone leans no more than in take-off around times ``(N,)``, for any plausible delay."""
    return np.asarray(track.leaned(at_s, _UNPROVEN_S) < _STEADY_RAD)


def headings(
    track: TelemetryTrack, at_s: FloatArray, R_b_c: FloatArray, R_w_m: FloatArray, delay_sigma_s: float
) -> Headings | None:
    """Headings of the frames at increasing ``at_s`` ``(K,)``; None for fewer than two. Arguments as above."""
    frame = np.flatnonzero(track.covered(at_s, at_s))
    if len(frame) < 2:
        return None
    t = at_s[frame]
    R_b_w = np.swapaxes(track.attitude(t), 1, 2)
    turned = track.yaw(np.stack([t - 0.5 * _RATE_S, t, t + 0.5 * _RATE_S]))
    yaw, rate = turned[1], (turned[2] - turned[0]) / _RATE_S
    common = (
        np.full(len(t), _OFFSET_RAD),
        HEADING_DRIFT_RAD_S * (t - t[0]),
        TURN_SHARE * (yaw - yaw[0]),
        min(delay_sigma_s, DELAY_S) * rate,
    )
    covariance = HEADING_RAD**2 * np.eye(len(t)) + sum(np.outer(error, error) for error in common)
    return Headings(frame, R_b_c.T @ R_b_w @ R_w_m, R_w_m[2], np.linalg.inv(covariance))
