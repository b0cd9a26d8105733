"""Candidate trajectories of the local planner: each ends in a stop and must lie in free space."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.speed_dither import measurable
from edgeslam_torch.types import FloatArray

_HORIZON_S = 0.6
"""Time for which a candidate keeps its velocity before it stops; longer than a planning cycle."""
_SAMPLES = 8
_HEADINGS = 24
_SPEEDS = (0.3, 0.6, 1.0)


@dataclass(frozen=True, slots=True)
class Arcs:
    """Candidate trajectories; the first is to stop now."""

    velocity_w: FloatArray
    """``(C, 2)`` commanded velocity [m/s]."""
    share: FloatArray
    """``(C,)`` speed over the cruising speed."""
    p_w: FloatArray
    """``(C, S, 2)`` predicted positions until standstill [m]."""
    clearance_m: FloatArray
    """``(C,)`` minimum distance to non-free space along the trajectory [m]."""
    from_solid_m: FloatArray
    """``(C,)`` minimum distance to obstacles along the trajectory [m]."""

    @property
    def end_w(self) -> FloatArray:
        """``(C, 2)`` final positions [m]."""
        return self.p_w[:, -1]


def candidates(
    layer: Layer,
    p_w: FloatArray,
    velocity_w: FloatArray,
    ahead_rad: float,
    limits: NavLimits,
    speed_m_s: float,
    blind: bool = False,
) -> Arcs:
    """Trajectories in all directions at several speeds.

    Args:
        layer: Current layer.
        p_w: Position ``(2,)``.
        velocity_w: Velocity ``(2,)`` [m/s].
        ahead_rad: Bearing of the path, one of the directions.
        limits: Latency and time constant of the drone.
        speed_m_s: Cruising speed.
        blind: Whether the drone flies by dead reckoning, so that velocities below the quantisation step are useless.
    """
    angle = ahead_rad + 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    share = np.repeat([0.0, *_SPEEDS], [1, *[_HEADINGS] * len(_SPEEDS)])
    wanted = speed_m_s * share[:, None] * np.concatenate([np.zeros((1, 2)), *[unit] * len(_SPEEDS)])
    wanted = measurable(wanted) if blind else wanted
    p = flown(np.asarray(p_w, dtype=np.float64), np.asarray(velocity_w, dtype=np.float64), wanted, limits)
    return Arcs(wanted, share, p, layer.clearance_at(p).min(axis=1), layer.from_solid_at(p).min(axis=1))


def flown(p_w: FloatArray, velocity_w: FloatArray, wanted_w: FloatArray, limits: NavLimits) -> FloatArray:
    """Predicted positions ``(C, S, 2)``: latency, first-order response to ``wanted_w`` ``(C, 2)``, then a stop."""
    tau = limits.settle_s
    late = p_w + limits.reaction_s * velocity_w
    t = np.linspace(0.0, _HORIZON_S, _SAMPLES - 1)[None, :, None]
    rest = tau * (1.0 - np.exp(-t / tau))
    moving = late + wanted_w[:, None] * t + (velocity_w - wanted_w)[:, None] * rest
    speed = wanted_w + (velocity_w - wanted_w) * np.exp(-_HORIZON_S / tau)
    stopped = moving[:, -1] + speed * tau
    return np.concatenate([moving, stopped[:, None]], axis=1)
