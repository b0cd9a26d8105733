"""A piece of map that is turned otherwise than the flight's first one: the drone's attitude tells.

A piece begins at a predicted pose. In a turn, before the video's delay is known, that may look tens of degrees beside
where the camera looks, and images of two pieces that show nothing in common never tell.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import sim3
from edgeslam_torch.geometry.rotations import matrix_from_rpy, turn_left
from edgeslam_torch.types import FloatArray

SIGMAS = 3.0

Facing = tuple[FloatArray, float]
"""How some frames' map is turned in the drone's world, ``R_w_m`` ``(3, 3)``, and the standard deviation [rad] of its
turn about the vertical."""


@dataclass(frozen=True, slots=True)
class Turned:
    """A piece that was turned as another one is."""

    stamp_s: float
    piece: int
    S: FloatArray
    """``(4, 4)`` similarity that moved it: about where it began."""
    angle_rad: float
    """About the vertical, to the left."""
    sigma_rad: float

    def growth(self, piece: int, keyframe_id: int) -> float:
        """Factor by which the map grew around a keyframe: none."""
        return 1.0

    def __str__(self) -> str:
        """For `status.csv` and the summary."""
        angle, sigma = np.rad2deg((self.angle_rad, self.sigma_rad))
        return f"piece {self.piece} turned by {angle:.1f} degrees (sigma {sigma:.1f}) to the heading before it"


def angle_between(mine: Facing, other: Facing) -> tuple[float, float]:
    """Angle [rad] about the vertical, to the left, by which a piece must be turned to be turned as another one, and its
    standard deviation."""
    (R_w_mine, mine_rad), (R_w_other, other_rad) = mine, other
    return float(turn_left(R_w_mine @ R_w_other.T)), float(np.hypot(mine_rad, other_rad))


def is_turned(angle_rad: float, sigma_rad: float) -> bool:
    """Whether an angle is surely not 0.

    Example:
        >>> is_turned(0.4, 0.06), is_turned(0.1, 0.06)
        (True, False)
    """
    return abs(angle_rad) > SIGMAS * sigma_rad


def turn_about(centre: FloatArray, R_w_m: FloatArray, angle_rad: float) -> FloatArray:
    """The similarity ``(4, 4)`` that turns by an angle about the vertical through a point ``(3,)``.

    Args:
        centre: In the map.
        R_w_m: Map to world ``(3, 3)``, the z axis of which is up.
        angle_rad: To the left.

    Example:
        >>> S = turn_about(np.array([1.0, 0.0, 0.0]), np.eye(3), np.pi / 2)
        >>> (S @ [2.0, 0.0, 0.0, 1.0]).round(9).tolist()
        [1.0, 1.0, 0.0, 1.0]
    """
    R = R_w_m.T @ matrix_from_rpy(np.array([0.0, 0.0, angle_rad])) @ R_w_m
    return sim3.compose(1.0, R, centre - R @ centre)
