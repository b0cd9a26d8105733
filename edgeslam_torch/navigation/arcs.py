"""Candidate movements: each ends in a stop, and all of it must be known to be free."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.speed_dither import measurable
from edgeslam_torch.types import FloatArray

_HORIZON_S = 0.6
"""A decision is kept for less than this; beyond it the candidate stops."""
_SAMPLES = 8
_HEADINGS = 24
_SPEEDS = (0.3, 0.6, 1.0)


@dataclass(frozen=True, slots=True)
class Arcs:
    """Candidates, the first of which is to stop now."""

    velocity_w: FloatArray
    """``(C, 2)`` wanted velocity [m/s]."""
    p_w: FloatArray
    """``(C, S, 2)`` positions until each stands [m]."""
    clearance_m: FloatArray
    """``(C,)`` least distance from what is not known to be free, along it."""
    from_solid_m: FloatArray
    """``(C,)`` least distance from what is known to be solid."""

    @property
    def end_w(self) -> FloatArray:
        """``(C, 2)`` where each stands."""
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
    """Velocities in all directions at some speeds, flown for a moment and stopped.

    Args:
        layer: What is known to be free.
        p_w: Position ``(2,)``.
        velocity_w: Velocity ``(2,)`` [m/s].
        ahead_rad: One of the directions: that of the way.
        limits: Reaction and settling of the drone.
        speed_m_s: The highest of the speeds.
        blind: Whether telemetry alone will tell where they lead to.
    """
    angle = ahead_rad + 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wanted = np.concatenate([np.zeros((1, 2)), *(speed_m_s * s * unit for s in _SPEEDS)])
    wanted = measurable(wanted) if blind else wanted
    p = flown(np.asarray(p_w, dtype=np.float64), np.asarray(velocity_w, dtype=np.float64), wanted, limits)
    return Arcs(wanted, p, layer.clearance_at(p).min(axis=1), layer.from_solid_at(p).min(axis=1))


def flown(p_w: FloatArray, velocity_w: FloatArray, wanted_w: FloatArray, limits: NavLimits) -> FloatArray:
    """Positions ``(C, S, 2)`` of a drone that reacts late, follows ``wanted_w`` ``(C, 2)`` and then stops.

    The speed approaches what is wanted exponentially, as a Tello's does.
    """
    tau = limits.settle_s
    late = p_w + limits.reaction_s * velocity_w
    t = np.linspace(0.0, _HORIZON_S, _SAMPLES - 1)[None, :, None]
    rest = tau * (1.0 - np.exp(-t / tau))
    moving = late + wanted_w[:, None] * t + (velocity_w - wanted_w)[:, None] * rest
    speed = wanted_w + (velocity_w - wanted_w) * np.exp(-_HORIZON_S / tau)
    stopped = moving[:, -1] + speed * tau
    return np.concatenate([moving, stopped[:, None]], axis=1)
