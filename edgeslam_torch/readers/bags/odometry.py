"""Velocities of ``Odometry``: in the body's axes, as ROS defines them, unless its own positions say otherwise."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.types import FloatArray

_SPAN_S = 0.4
"""Time over which positions are compared with velocities."""
_MIN_WAY_M = 0.5
"""Minimum path length."""
_DECISIVE = 0.25
"""Ratio of squared errors below which the positions refute the definition."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Velocity and attitude over time, ``N`` readings."""

    stamps_s: FloatArray
    velocity_m_s: FloatArray
    """``(N, 3)`` in the world, NaN where unknown."""
    rpy_rad: FloatArray
    """``(N, 3)`` of the body in the same world."""


def motion_of_odometry(table: FloatArray, frame: str, child: str) -> tuple[Motion | None, str | None]:
    """Motion in the world of the odometry, and a remark.

    Args:
        table: ``(N, 11)`` stamp, position, quaternion ``x y z w``, linear velocity.
        frame: Of the pose.
        child: Of the velocity; the body, or ``frame`` again.

    Returns:
        No motion if there is neither attitude nor velocity.
    """
    from scipy.spatial.transform import Rotation

    quaternion = table[:, 4:8]
    unit = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) < 0.01
    table = table[unit & np.isfinite(table).all(axis=1)]
    if len(table) < 2:
        return None, "holds no attitude, so it is not used"
    stamps, position, velocity = table[:, 0], table[:, 1:4], table[:, 8:11]
    turn = Rotation.from_quat(table[:, 4:8])
    rpy = turn.as_euler("ZYX")[:, ::-1]
    turned, remark = turn.apply(velocity), None
    way_m = float(np.linalg.norm(np.diff(position[:: max(1, len(position) // 500)], axis=0), axis=1).sum())
    if not velocity.any():
        if way_m < _MIN_WAY_M:
            return None, "its velocities and positions are constant, so it is not used"
        return Motion(
            stamps, np.gradient(position, stamps, axis=0), rpy
        ), "its velocities are zero; made from positions"
    in_world = child != "" and child == frame
    if way_m >= _MIN_WAY_M:
        as_body, as_world = (_misfit(stamps, position, v) for v in (turned, velocity))
        better_world = as_world < _DECISIVE * as_body
        better_body = as_body < _DECISIVE * as_world
        if better_world and not in_world:
            in_world, remark = True, "its velocities are along the axes of its world, as its positions show"
        elif better_body and in_world:
            in_world, remark = False, "its velocities are along the axes of the body, as its positions show"
    return Motion(stamps, velocity if in_world else turned, rpy), remark


def _misfit(stamps: FloatArray, position: FloatArray, velocity: FloatArray) -> float:
    """Mean square of displacement minus integrated velocity over `_SPAN_S` [m^2]."""
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(stamps)[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    later = np.searchsorted(stamps, stamps + _SPAN_S)
    first = np.flatnonzero(later < len(stamps))
    first = first[stamps[later[first]] - stamps[first] < 2 * _SPAN_S]
    if len(first) == 0:
        return 0.0
    error = (position[later[first]] - position[first]) - (path[later[first]] - path[first])
    return float(np.mean(np.sum(error**2, axis=1)))
