"""What a pilot is told at each moment: where the drone is, and what it saw."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class View:
    """A depth map, and where it was taken."""

    stamp_s: float
    depth_m: FloatArray
    """``(H, W)`` z-depth [m]; NaN or at most 0 where unknown."""
    sigma_log: FloatArray
    """``(H, W)`` standard deviation of its logarithm."""
    K: FloatArray
    """``(3, 3)`` of a camera without distortion [px]."""
    T_w_c: FloatArray
    """``(4, 4)`` metric; in the drone's world: origin on the floor at power-on, x forward, y left, z up."""
    picture: int = -1
    """Number of the picture that it was seen in; -1 where nobody asks."""


@dataclass(frozen=True, slots=True)
class DroneState:
    """The moment as a pilot knows it."""

    stamp_s: float
    p_w: FloatArray
    """``(3,)`` position in the drone's world [m]."""
    yaw_rad: float
    velocity_w: FloatArray
    """``(3,)`` [m/s]."""
    position_sigma_m: float = 0.02
    submap_sigma_m: float = 0.0
    """Standard deviation of where the piece of map that it is in lies to that of the take-off; 0 in one map."""
    drift_sigma_m: float = 0.0
    """Standard deviation of what the map may have drifted by since the take-off."""
    submap: int = 0
    """Number of the piece of map."""
    scale_sigma: float = 0.0
    """Relative standard deviation of a metre."""
    metric: bool = True
    """Whether the unit is a metre at all."""
    tracked: bool = True
    """Whether the pose rests on a map."""
    conflict: bool = False
    """Whether sources of scale contradict each other."""
    seen_s: float = math.nan
    """When the newest picture that arrived was taken; NaN for now."""
    battery: float = 1.0
    reported_height_m: float = math.nan
    """Height above the floor of the take-off as the drone itself says; NaN if it does not."""
    reported_speed_m_s: float = math.nan
    """Level speed as the drone itself says; NaN if it does not."""
    view: View | None = None
    """A new depth map, if there is one."""
    revision: int = 0
    """How often the unit of the positions was revised; after a change, earlier ones mean something else."""
    map_update: MapUpdate | None = None
    """How the map moved since the last state with a view; None where it did not."""
    overridden: bool = False
    """Whether the last command was not followed: the supervisor or a hand had something else in mind."""

    @property
    def home_sigma_m(self) -> float:
        """Standard deviation of where it is, seen from its take-off, by all that is known but the length of a metre."""
        return math.hypot(self.position_sigma_m, self.submap_sigma_m, self.drift_sigma_m)

    @property
    def blind_s(self) -> float:
        """Age of the newest picture."""
        return 0.0 if math.isnan(self.seen_s) else self.stamp_s - self.seen_s


@dataclass(frozen=True, slots=True)
class Contact:
    """The drone was told to move and did not: something holds it that it does not see."""

    p_w: FloatArray
    """``(3,)`` where the drone was [m]."""
    towards_w: FloatArray
    """``(2,)`` level unit vector of where it was to go."""


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """What the drone should do until the next moment, in its own level axes."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    up_m_s: float = 0.0
    turn_left_rad_s: float = 0.0
    why: str = ""
    """For the log and the live view."""

    def sticks(self) -> tuple[float, float, float, float]:
        """Right, forward, up, clockwise in [-1, 1], as a Tello reads them: 1 m/s and 100 degrees a second in full.

        Example:
            >>> VelocityCommand(forward_m_s=0.5, turn_left_rad_s=-0.5).sticks()
            (-0.0, 0.5, 0.0, 0.286)
        """
        values = (-self.left_m_s, self.forward_m_s, self.up_m_s, -self.turn_left_rad_s / math.radians(100.0))
        if not all(map(math.isfinite, values)):
            raise ValueError(f"a command must be finite: {self}")
        right, forward, up, clockwise = (round(float(np.clip(v, -1.0, 1.0)), 3) for v in values)
        return right, forward, up, clockwise


HOVER = VelocityCommand(why="hover")
