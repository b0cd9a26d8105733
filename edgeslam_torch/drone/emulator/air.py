"""Aerodynamics of a small drone: drag, wind with gusts, propeller wash near walls and floor."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.drone.sdk_state import GRAVITY_M_S2
from edgeslam_torch.types import FloatArray

DRAG_PER_S = 0.35
"""Deceleration by moving air, per metre a second: a Tello of 87 g that leans 10 degrees flies at about 5 m/s."""
_GUST_S = 2.0
"""Correlation time of gusts indoors."""
_WASH_M = 0.35
"""Distance at which a wall begins to matter: three radii of the propellers' circle."""
_WASH_M_S2 = 0.25
"""Disturbance at contact; the recirculated wash pulls towards a wall and shakes."""
_PROPELLER_M = 0.038
"""Radius of a propeller."""


@dataclass(slots=True)
class Air:
    """Air of a room or of an open hall."""

    wind_m_s: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Mean wind in the drone's world ``(3,)``."""
    gust_m_s: float = 0.0
    """Standard deviation of each component of the gusts."""
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    _gust: FloatArray = field(default_factory=lambda: np.zeros(3))

    def drag(self, velocity_m_s: FloatArray, dt: float) -> FloatArray:
        """Acceleration ``(3,)`` [m/s^2] by the air that moves past; gusts change with time (Ornstein-Uhlenbeck)."""
        if self.gust_m_s > 0:
            keep = math.exp(-dt / _GUST_S)
            shake = self.gust_m_s * math.sqrt(1.0 - keep * keep)
            self._gust = keep * self._gust + shake * self.rng.standard_normal(3)
        return DRAG_PER_S * (self.wind_m_s + self._gust - velocity_m_s)

    def wash(self, clearance_m: float) -> FloatArray:
        """Shaking ``(3,)`` [m/s^2] by the drone's own wash near a surface; zero beyond `_WASH_M`."""
        near = max(0.0, 1.0 - clearance_m / _WASH_M)
        return _WASH_M_S2 * near * self.rng.standard_normal(3) if near > 0 else np.zeros(3)


def ground_effect(height_m: float) -> float:
    """Upward acceleration [m/s^2] at hover thrust, ``height_m`` above the floor (Cheeseman and Bennett 1955).

    Example:
        >>> ground_effect(1.0) < 0.01 < 0.3 < ground_effect(0.05)
        True
    """
    ratio = _PROPELLER_M / (4.0 * max(height_m, _PROPELLER_M))
    return GRAVITY_M_S2 * (1.0 / (1.0 - ratio * ratio) - 1.0)
