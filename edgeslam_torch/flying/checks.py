"""Checks before anything moves."""

from collections.abc import Sequence

import numpy as np

from edgeslam_torch.flying.result import FlightRefused
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.types import FloatArray

NO_FLY = "motion is not allowed: give --fly (in Python allow_motion=True)"
NEAR_HEIGHT_M = 0.25
"""Maximum difference between a goal's height and the flight height."""


def check_fit(allow_motion: bool, battery: float, limits: NavLimits, guessed_camera: bool) -> None:
    """Whether a drone may take off.

    Raises:
        FlightRefused: If it may not.
    """
    if not allow_motion:
        raise FlightRefused(NO_FLY)
    if guessed_camera:
        raise FlightRefused(
            "no calibration of this camera, so the scale is not metric: give --camera FILE "
            "(make one with: edgeslam calibrate)"
        )
    if battery <= limits.home_battery:
        raise FlightRefused(
            f"battery at {100 * battery:.0f} %: a flight returns home at {100 * limits.home_battery:.0f} %"
        )


def check_goal(goal_w: Sequence[float] | FloatArray, limits: NavLimits, layer: Layer | None = None) -> FloatArray:
    """Validated goal ``(3,)``: finite, within the fence, near the flight height, not inside a known obstacle.

    Args:
        goal_w: Goal in the drone's world [m].
        limits: Limits of the flight.
        layer: Current layer; no obstacle check when None.

    Raises:
        FlightRefused: If the goal is invalid.
    """
    try:
        goal = np.asarray(goal_w, dtype=np.float64)
    except (TypeError, ValueError):
        raise FlightRefused(f"a goal is three numbers (x, y, z) in metres, not {goal_w!r}") from None
    if goal.shape != (3,) or not np.isfinite(goal).all():
        raise FlightRefused(f"a goal is three finite numbers (x, y, z) in metres, not {goal.tolist()}")
    away = float(np.linalg.norm(goal[:2]))
    if away > limits.fence_m:
        raise FlightRefused(f"the goal is {away:.1f} m from the take-off, the fence is at {limits.fence_m:.1f} m")
    if abs(goal[2] - limits.height_m) > NEAR_HEIGHT_M:
        raise FlightRefused(
            f"the goal is {goal[2]:.2f} m high, but the flight height is {limits.height_m:.2f} m "
            f"(within {NEAR_HEIGHT_M:.2f} m): give NavLimits(height_m=...), --height on the command line"
        )
    if layer is not None and _inside(goal[:2], layer, limits):
        raise FlightRefused(f"the goal ({goal[0]:.2f}, {goal[1]:.2f}) is inside an obstacle or too close to one")
    return goal


def _inside(goal_w: FloatArray, layer: Layer, limits: NavLimits) -> bool:
    at = np.floor((goal_w - layer.corner_w) / layer.cell_m).astype(int)
    if (at < 0).any() or (at >= layer.solid.shape).any():
        return False
    return bool(layer.from_solid_m[at[0], at[1]] < limits.radius_m)
