"""Dithered speeds: a Tello truncates reported velocities to whole dm/s.

At a constant speed truncation biases the reported velocity by 0 to 1 step, and with it the metric scale. Sweeping the
speed uniformly over one step decorrelates the error: its mean is then exactly half a step, which can be corrected.
"""

import numpy as np

from edgeslam_torch.types import FloatArray

STEP_M_S = 0.1
"""Quantisation step of a Tello's reported velocity."""
_VARIES_S = 4.0
"""Period of the triangle wave."""


def dithered(mean_m_s: float, stamp_s: float) -> float:
    """Speed [m/s] at a time: a triangle wave over one step, at most over a third of the mean to each side.

    >>> [round(dithered(0.5, t), 2) for t in (0.0, 1.0, 2.0, 3.0)]
    [0.45, 0.5, 0.55, 0.5]
    """
    share = abs(2.0 * (stamp_s / _VARIES_S % 1.0) - 1.0)
    return mean_m_s + min(STEP_M_S, 2.0 / 3.0 * mean_m_s) * (0.5 - share)


def measurable(velocity_w: FloatArray) -> FloatArray:
    """Velocities ``(..., 2)`` with components below the quantisation step set to 0.

    Telemetry reports such components as 0, so dead reckoning misses them: 5 cm/s are half a metre in ten seconds.

    Args:
        velocity_w: In the drone's power-on axes, in which it reports them [m/s].

    >>> measurable(np.array([-0.25, 0.04]))
    array([-0.25,  0.  ])
    """
    return np.where(np.abs(velocity_w) < STEP_M_S, 0.0, velocity_w)
