"""The vertical from an accelerometer: its mean specific force in map coordinates; fusion with that from edges."""

import math

import numpy as np

from edgeslam_torch.geometry.level import Up
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.types import FloatArray

_G_M_S2 = 9.81
_OFF = 0.15
"""Maximum relative deviation of a mean force from gravity; beyond, the unit is wrong or the camera falls."""
_MIN_S = 0.5
"""Minimum duration of a mean."""
_MAX_GAP_S = 0.2
"""Maximum time between a reading and the pose that rotates it into the map."""
_MAX_SIGMA = math.radians(8.0)
"""Maximum standard deviation of a usable result."""
_CONTRADICTION = 3.0
"""Number of sigmas between gravity and edges above which they contradict each other."""


_IMU_RAD, _ACCELEROMETER_RAD = math.radians(1.0), math.radians(4.0)
"""Standard deviation of the mean force's direction: biases of 0.1 m/s^2 and the calibration of the mount; an
accelerometer alone, as a Kinect's, is not calibrated."""


def up_by_gravity(readings: ImuReadings, model: ImuModel, stamps_s: FloatArray, T_w_c: FloatArray) -> Up | None:
    """Vertical of a map from accelerometer readings; None if they do not determine it.

    The mean force is the reaction to gravity plus the mean acceleration, the change of velocity over the duration. This
    is unknown without a metric scale; the difference between the two halves serves as its uncertainty.

    Args:
        readings: Readings.
        model: Mount and clock; without a mount, nothing is determined.
        stamps_s: ``(F,)`` stamps of the poses.
        T_w_c: ``(F, 4, 4)`` poses.
    """
    if len(stamps_s) < 2 or model.T_imu_cam is None:
        return None
    felt_s = readings.stamps_s - (model.time_offset_s or 0.0)
    force_c = readings.acceleration_m_s2 @ model.T_imu_cam[:3, :3]
    at = np.searchsorted(stamps_s, felt_s).clip(1, len(stamps_s) - 1)
    at -= felt_s - stamps_s[at - 1] < stamps_s[at] - felt_s
    near = np.abs(stamps_s[at] - felt_s) < _MAX_GAP_S
    if near.sum() < 10 or float(np.ptp(felt_s[near])) < _MIN_S:
        return None
    felt_w = np.einsum("nij,nj->ni", T_w_c[at[near], :3, :3], force_c[near])
    mean = felt_w.mean(axis=0)
    g = float(np.linalg.norm(mean))
    if abs(g / _G_M_S2 - 1.0) > _OFF:
        return None
    first, second = (half.mean(axis=0) for half in np.array_split(felt_w, 2))
    spread = float(np.linalg.norm(np.cross(first, second))) / (2.0 * g * g)
    sigma = math.hypot(_IMU_RAD if readings.has_gyroscope else _ACCELEROMETER_RAD, spread)
    return Up(mean / g, sigma, "accelerometer") if sigma < _MAX_SIGMA else None


def best_known(by_gravity: Up | None, by_edges: Up | None) -> Up | None:
    """Fuse both verticals; gravity alone if it is more certain and they contradict each other."""
    if by_gravity is None or by_edges is None:
        return by_gravity or by_edges
    sigma = math.hypot(by_gravity.sigma_rad, by_edges.sigma_rad)
    angle_rad = math.acos(float(np.clip(by_gravity.direction @ by_edges.direction, -1.0, 1.0)))
    if angle_rad > _CONTRADICTION * sigma:
        return by_gravity  # edges may confuse the axes of a room, gravity cannot
    weights = np.array([by_gravity.sigma_rad, by_edges.sigma_rad]) ** -2.0
    both = weights[0] * by_gravity.direction + weights[1] * by_edges.direction
    return Up(both / np.linalg.norm(both), float(weights.sum()) ** -0.5, "accelerometer+edges")
