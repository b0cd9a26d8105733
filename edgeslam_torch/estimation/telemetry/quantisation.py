"""Quantisation of a velocity: the reading to be expected at a speed."""

import math
from enum import StrEnum
from functools import lru_cache

import numpy as np

from edgeslam_torch.types import FloatArray

_NOISE_STEPS = 0.4
"""Noise of a velocity before quantisation [steps]: 0.02 to 0.03 m/s of the sensor, and 0.03 to 0.04 m/s of vision over
a tenth of a second."""
_FEW_STEPS, _FINE = 4.0, 0.02
"""Speed above which the remainder is constant, and resolution of the grid below [steps]."""


class Rounding(StrEnum):
    """Quantisation mode of a velocity."""

    NEAREST = "nearest"
    TRUNCATE = "truncate"


@lru_cache(maxsize=2)
def _table(rounding: Rounding) -> tuple[FloatArray, FloatArray]:
    """Speeds from 0 up, and the expected remainder at each [steps]."""
    speed = np.arange(0.0, _FEW_STEPS + 0.5 * _FINE, _FINE)
    first = 1.0 if rounding is Rounding.TRUNCATE else 0.5
    edges = first + np.arange(_FEW_STEPS + 4.0)

    def passed(x: FloatArray) -> FloatArray:
        """Expected number of quantisation thresholds below ``x`` plus noise."""
        z = (x[:, None] - edges) / (_NOISE_STEPS * math.sqrt(2.0))
        return np.array([[0.5 * math.erfc(-v) for v in row] for row in z.tolist()]).sum(axis=1)

    return speed, speed - (passed(speed) - passed(-speed))


def remainder(velocity_steps: FloatArray, rounding: Rounding) -> FloatArray:
    """Expected true minus reported velocity [steps], for true velocities [steps] of any shape."""
    speed, lost = _table(rounding)
    return np.asarray(np.sign(velocity_steps) * np.interp(np.abs(velocity_steps), speed, lost))
