"""Camera mount on the drone's body."""

import math

import numpy as np

from edgeslam_torch.types import FloatArray

TELLO_TILT_RAD, TELLO_FORWARD_M = math.radians(12.0), 0.03
"""Tilt and offset of a Tello's camera, within two degrees and about a centimetre."""


def camera_on_body(tilt_rad: float = TELLO_TILT_RAD, forward_m: float = TELLO_FORWARD_M) -> FloatArray:
    """``T_b_c`` ``(4, 4)`` of a forward-looking camera tilted down by ``tilt_rad``.

    Example:
        >>> bool(np.allclose(camera_on_body(0.0, 0.0)[:3, 2], [1.0, 0.0, 0.0]))  # optical axis along body x
        True
    """
    s, c = np.sin(tilt_rad), np.cos(tilt_rad)
    T = np.eye(4)
    # Columns: camera x (right), y (down), z (forward) in body axes x forward, y left, z up.
    T[:3, :3] = [[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]]
    T[0, 3] = forward_m
    return T
