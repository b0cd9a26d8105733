"""Limits of a flight and dimensions of the drone."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class NavLimits:
    """Limits that planner and supervisor enforce."""

    speed_m_s: float = 0.5
    """Mean cruising speed in free space; it varies by half a step of the reported velocity (`speed_dither`)."""
    turn_rad_s: float = math.radians(60.0)
    climb_m_s: float = 0.3
    height_m: float = 1.15
    """Flight height above the floor."""
    lowest_m: float = 0.5
    highest_m: float = 1.9
    radius_m: float = 0.1
    """Radius of the drone's bounding sphere."""
    margin_m: float = 0.15
    """Margin beyond hull and uncertainty, for propeller wash and gusts."""
    fence_m: float = 30.0
    """Maximum horizontal distance from the take-off."""
    reaction_s: float = 0.2
    """Latency from a decision to its effect: radio, drone, one frame."""
    settle_s: float = 0.35
    """Time constant of the drone's velocity response."""
    home_battery: float = 0.25
    land_battery: float = 0.10

    def __post_init__(self) -> None:
        if not 0.05 <= self.speed_m_s <= 1.0 or not 0 < self.climb_m_s <= 1.0 or not 0 < self.turn_rad_s <= 1.8:
            raise ValueError(f"speed 0.05 to 1, climb up to 1 m/s, turn up to 1.8 rad/s: {self}")
        if not 0.2 <= self.lowest_m <= self.height_m <= self.highest_m:
            raise ValueError(f"lowest_m (at least 0.2), height_m, highest_m must be in this order: {self}")
        if min(self.radius_m, self.fence_m, self.reaction_s, self.settle_s) <= 0 or self.margin_m < 0:
            raise ValueError(f"radius, fence and times must be positive, the margin at least 0: {self}")
        if not 0 <= self.land_battery <= self.home_battery < 1:
            raise ValueError(f"0 <= land_battery <= home_battery < 1: {self}")

    def clearance_m(self, position_sigma_m: float) -> float:
        """Required distance [m] of the drone's centre from non-free space: hull, margin and two standard deviations."""
        return self.radius_m + self.margin_m + 2.0 * position_sigma_m
