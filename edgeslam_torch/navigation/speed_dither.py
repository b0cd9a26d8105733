"""Velocities of which a Tello tells the truth on average: it cuts what it tells off to whole decimetres a second.

One speed kept to would be told up to a whole step too low, and every metre be too short; or too long, where half a step
is added for what is cut off. A speed that goes evenly through one step is told half a step too low.
"""

import numpy as np

from edgeslam_torch.types import FloatArray

STEP_M_S = 0.1
"""In which a Tello tells its velocity."""
_VARIES_S = 4.0
"""Time in which the speed goes down and up again."""


def dithered(fastest_m_s: float, stamp_s: float) -> float:
    """The speed at a moment: the fastest, and evenly down to a step below it, but not below half of it.

    >>> [round(dithered(0.5, t), 2) for t in (0.0, 1.0, 2.0, 3.0)]
    [0.4, 0.45, 0.5, 0.45]
    """
    share = abs(2.0 * (stamp_s / _VARIES_S % 1.0) - 1.0)
    return fastest_m_s - min(STEP_M_S, 0.5 * fastest_m_s) * share


def measurable(velocity_w: FloatArray) -> FloatArray:
    """Velocities ``(..., 2)`` without the components of which nothing is told: a drone that drifts sideways by 5 cm a
    second, without a picture, is half a metre beside where it is consistent to be after ten seconds.

    Args:
        velocity_w: In the drone's power-on axes, in which it tells them [m/s].

    >>> measurable(np.array([-0.25, 0.04]))
    array([-0.25,  0.  ])
    """
    return np.where(np.abs(velocity_w) < STEP_M_S, 0.0, velocity_w)
