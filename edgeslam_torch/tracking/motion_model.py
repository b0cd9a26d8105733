"""Motion model: pose and velocity of the camera, and the uncertainty of a predicted pose."""

import math

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray

ACCELERATION_M_S2 = 3.0
ANGULAR_ACCELERATION_RAD_S2 = 20.0
"""Standard deviations for a hand or a small drone: a tilt of 17 degrees; half a revolution per second within 0.15
s."""

FADING = 0.8
"""Decay of the velocity per frame without a pose: after a second it is irrelevant."""

SPEED_M_S = 0.5
ANGULAR_SPEED_RAD_S = 1.0
"""Standard deviations of the velocity while it is unknown."""


class MotionModel:
    """Pose and velocity of the camera in the map's units and axes."""

    def __init__(self, T_c_w: FloatArray) -> None:
        self.T_c_w = T_c_w
        """``(4, 4)`` current pose."""
        self.stamp_s = -np.inf
        """Stamp of the newest frame."""
        self.seen_s = -np.inf
        """Stamp of the newest measured pose."""
        self._velocity: FloatArray = np.zeros(6)
        """Tangent of the camera's motion per second, left-applied to ``T_c_w``."""

    @property
    def velocity_unknown(self) -> bool:
        """Whether the velocity is unknown."""
        return not np.any(self._velocity)

    def predict(self, stamp_s: float) -> FloatArray:
        """``T_c_w`` at a stamp, at constant velocity."""
        # Each pose is a product with the previous one: projected to SE(3), rounding errors do not accumulate.
        return se3.orthonormalised(se3.exp(self._velocity * (stamp_s - self.stamp_s)) @ self.T_c_w)

    def information(self, stamp_s: float, metres_per_unit: float) -> FloatArray:
        """Information ``(6, 6)`` of a predicted pose, left perturbation: limited by accelerations since the newest
        frame."""
        dt = stamp_s - self.stamp_s
        speed, turn = (SPEED_M_S, ANGULAR_SPEED_RAD_S) if self.velocity_unknown else (0.0, 0.0)  # motion is possible
        sigma_t = math.hypot(speed * dt, 0.5 * ACCELERATION_M_S2 * dt**2) / metres_per_unit
        sigma_r = math.hypot(turn * dt, 0.5 * ANGULAR_ACCELERATION_RAD_S2 * dt**2)
        return np.diag([sigma_t**-2] * 3 + [sigma_r**-2] * 3)

    def move(self, stamp_s: float, T_c_w: FloatArray) -> None:
        """Accept a measured pose and update the velocity."""
        self._velocity = se3.log(T_c_w @ se3.inverse(self.T_c_w)) / max(stamp_s - self.stamp_s, 1e-6)
        self.T_c_w = T_c_w
        self.seen_s = stamp_s

    def drift(self, T_predicted: FloatArray) -> None:
        """Accept a prediction as the current pose and decay the velocity."""
        self.T_c_w = T_predicted
        self._velocity = FADING * self._velocity

    def stop(self) -> None:
        """Reset the velocity after a discontinuity."""
        self._velocity = np.zeros(6)

    def transform(self, T_c_w: FloatArray, scale: float) -> None:
        """Transform with a map that was moved and scaled."""
        self.T_c_w = se3.orthonormalised(T_c_w)
        self._velocity = self._velocity * np.array([scale] * 3 + [1.0] * 3)

    def correct(self, T_c_c: FloatArray) -> None:
        """Apply a refinement that moved the reference keyframe by ``(4, 4)`` on the right."""
        self.T_c_w = se3.orthonormalised(self.T_c_w @ T_c_c)
