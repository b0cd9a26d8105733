"""Planner input and output: drone state, depth view, contact, velocity command."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.geometry.rotations import wrapped
from edgeslam_torch.navigation.map_views import MapUpdate, MapViews
from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class View:
    """A depth map and the pose of its camera."""

    stamp_s: float
    depth_m: FloatArray
    """``(H, W)`` z-depth [m]; NaN or at most 0 where unknown."""
    sigma_log: FloatArray
    """``(H, W)`` standard deviation of log depth."""
    K: FloatArray
    """``(3, 3)`` intrinsics without distortion [px]."""
    T_w_c: FloatArray
    """``(4, 4)`` metric pose in the drone's world: origin on the floor at power-on, x forward, y left, z up."""
    picture: int = -1
    """Frame number; -1 if unknown."""


@dataclass(frozen=True, slots=True)
class DroneState:
    """Estimated state of the drone at one time."""

    stamp_s: float
    p_w: FloatArray
    """``(3,)`` position in the drone's world [m]."""
    yaw_rad: float
    velocity_w: FloatArray
    """``(3,)`` [m/s]."""
    position_sigma_m: float = 0.02
    submap_sigma_m: float = 0.0
    """Standard deviation of the current submap's position relative to the take-off submap; 0 in one submap [m]."""
    drift_sigma_m: float = 0.0
    """Standard deviation of the map's drift since the take-off [m]."""
    submap: int = 0
    """Number of the current submap."""
    scale_sigma: float = 0.0
    """Relative standard deviation of the metric scale."""
    metric: bool = True
    """Whether the scale is metric at all."""
    tracked: bool = True
    """Whether the pose is tracked against the map; otherwise it is dead reckoning by telemetry."""
    conflict: bool = False
    """Whether scale sources contradict each other."""
    seen_s: float = math.nan
    """Capture time of the newest frame that arrived; NaN for now."""
    battery: float = 1.0
    reported_height_m: float = math.nan
    """Height above the take-off floor reported by the drone [m]; NaN if unavailable."""
    reported_speed_m_s: float = math.nan
    """Horizontal speed reported by the drone [m/s]; NaN if unavailable."""
    view: View | None = None
    """New depth map, if any."""
    revision: int = 0
    """Number of scale revisions so far; positions of different revisions are not comparable."""
    map_update: MapUpdate | None = None
    """Correction of the map since the last state with a view; None if it did not change."""
    views: MapViews = field(default_factory=MapViews, repr=False, compare=False)
    """The planner's views of the map, to which positions are tied."""
    overridden: bool = False
    """Whether the supervisor or the operator overrode the last command."""

    @property
    def home_sigma_m(self) -> float:
        """Standard deviation of the position relative to the take-off [m], without scale uncertainty."""
        return math.hypot(self.position_sigma_m, self.submap_sigma_m, self.drift_sigma_m)

    def turn_to_rad(self, heading_rad: float) -> float:
        """Turn to the left to a heading, in [-pi, pi)."""
        return float(wrapped(np.array(heading_rad - self.yaw_rad)))

    @property
    def blind_s(self) -> float:
        """Age of the newest frame [s]."""
        return 0.0 if math.isnan(self.seen_s) else self.stamp_s - self.seen_s


@dataclass(frozen=True, slots=True)
class Contact:
    """The drone was commanded to move and did not: an obstacle that no view shows."""

    p_w: FloatArray
    """``(3,)`` position of the drone [m]."""
    towards_w: FloatArray
    """``(2,)`` horizontal unit vector of the commanded direction."""


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Velocity setpoint in the drone's level body frame."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    up_m_s: float = 0.0
    turn_left_rad_s: float = 0.0
    why: str = ""
    """Reason, for the log and the live view."""

    def sticks(self) -> tuple[float, float, float, float]:
        """Stick positions right, forward, up, clockwise in [-1, 1]; a Tello's full scale is 1 m/s and 100 deg/s.

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
