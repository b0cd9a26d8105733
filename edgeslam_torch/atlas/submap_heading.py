"""Correction of a submap's heading to that of the flight's first one by the drone's attitude.

A submap begins at a predicted pose. In a turn with unknown video delay its heading may be wrong by tens of degrees, and
images cannot correct it before both submaps show a common place.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import sim3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, turn_left
from edgeslam_torch.types import FloatArray

SIGMAS = 3.0

Facing = tuple[FloatArray, float]
"""Orientation of a map in the drone's world, ``R_w_m`` ``(3, 3)``, and the standard deviation [rad] of its heading."""


@dataclass(frozen=True, slots=True)
class Turned:
    """A submap that was rotated to the heading of another."""

    stamp_s: float
    piece: int
    S: FloatArray
    """``(4, 4)`` similarity that moved it: a rotation about its start."""
    angle_rad: float
    """About the vertical, to the left."""
    sigma_rad: float

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Change of scale at a keyframe: none."""
        return 1.0

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        angle, sigma = np.rad2deg((self.angle_rad, self.sigma_rad))
        return f"piece {self.piece} rotated by {angle:.1f} degrees (sigma {sigma:.1f}) to the previous heading"


def angle_between(mine: Facing, other: Facing) -> tuple[float, float]:
    """Angle [rad] about the vertical, to the left, from a submap's heading to another one's, and its standard
    deviation."""
    (R_w_mine, mine_rad), (R_w_other, other_rad) = mine, other
    return float(turn_left(R_w_mine @ R_w_other.T)), float(np.hypot(mine_rad, other_rad))


def is_turned(angle_rad: float, sigma_rad: float) -> bool:
    """Whether an angle differs significantly from 0.

    Example:
        >>> is_turned(0.4, 0.06), is_turned(0.1, 0.06)
        (True, False)
    """
    return abs(angle_rad) > SIGMAS * sigma_rad


def turn_about(centre: FloatArray, R_w_m: FloatArray, angle_rad: float) -> FloatArray:
    """Similarity ``(4, 4)`` that rotates by an angle about the vertical through a point ``(3,)``.

    Args:
        centre: Point in the map.
        R_w_m: Map to world ``(3, 3)``, z axis up.
        angle_rad: To the left.

    Example:
        >>> S = turn_about(np.array([1.0, 0.0, 0.0]), np.eye(3), np.pi / 2)
        >>> (S @ [2.0, 0.0, 0.0, 1.0]).round(9).tolist()
        [1.0, 1.0, 0.0, 1.0]
    """
    R = R_w_m.T @ matrix_from_rpy(np.array([0.0, 0.0, angle_rad])) @ R_w_m
    return sim3.compose(1.0, R, centre - R @ centre)
