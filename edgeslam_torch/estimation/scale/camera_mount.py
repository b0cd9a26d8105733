"""Orientation of the camera on the drone, from rotations observed in camera and body axes."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.rotations import matrices_from_vectors, mean_rotation, vectors_from_matrices
from edgeslam_torch.noise import LEVEL_RAD, UP_MEMORY_S
from edgeslam_torch.types import FloatArray

_BENT_RAD = math.radians(1.0)
"""Variation of a map's orientation from place to place."""
_STEPS = 3
"""Gauss-Newton iterations: rotations of some degrees are nearly linear."""


@dataclass(frozen=True, slots=True)
class Turned:
    """Rotations of camera and map relative to the drone and its world."""

    R_b_c: FloatArray
    """``(3, 3)`` camera to body."""
    R_w_m: FloatArray
    """``(3, 3)`` map to the power-on world."""
    sigma_rad: FloatArray
    """``(3,)`` standard deviation of ``R_w_m`` about the world's axes."""


def mount_by_turns(
    R_m_c: FloatArray, R_w_b: FloatArray, stamps_s: FloatArray, R_b_c: FloatArray, sigma_rad: float
) -> Turned:
    """Robot-world and hand-eye calibration of rotations.

    ``R_w_m R_m_c = R_w_b R_b_c`` holds in all frames with both ``R_w_m`` and ``R_b_c`` unknown. Yaw makes them
    observable: a tilt of the camera rotates with the drone, a tilt of the map does not. Unobservable components stay at
    the prior.

    Args:
        R_m_c: Cameras in the map ``(N, 3, 3)``.
        R_w_b: The drone's attitude at the same times ``(N, 3, 3)``.
        stamps_s: Increasing stamps ``(N,)``.
        R_b_c: Configured camera to body ``(3, 3)``.
        sigma_rad: Its standard deviation per axis.
    """
    memory_s = 0.5 * UP_MEMORY_S
    count = np.searchsorted(stamps_s, stamps_s + memory_s, "right") - np.searchsorted(stamps_s, stamps_s - memory_s)
    weight = 1.0 / (LEVEL_RAD**2 * count)
    R_w_m = mean_rotation(R_w_b @ R_b_c @ np.swapaxes(R_m_c, 1, 2))
    R_b_w = np.swapaxes(R_w_b, 1, 2)
    J = np.concatenate([R_b_w, np.broadcast_to(-np.eye(3), R_b_w.shape)], axis=2)  # by rotations of R_w_m, R_b_c
    weighted = np.einsum("nai,n->ain", J, weight)
    prior = np.diag([0.0] * 3 + [sigma_rad**-2] * 3)
    covariance = np.linalg.inv(np.einsum("ain,naj->ij", weighted, J) + prior)
    turned = np.zeros(6)
    for _ in range(_STEPS):
        map_turned, mount_turned = matrices_from_vectors(turned.reshape(2, 3))
        error = vectors_from_matrices(R_b_w @ map_turned @ R_w_m @ R_m_c @ (mount_turned @ R_b_c).T)
        turned -= covariance @ (np.einsum("ain,na->i", weighted, error) + prior @ turned)
    map_turned, mount_turned = matrices_from_vectors(turned.reshape(2, 3))
    sigma = np.sqrt(np.diag(covariance)[:3] + _BENT_RAD**2)
    return Turned(mount_turned @ R_b_c, map_turned @ R_w_m, sigma)
