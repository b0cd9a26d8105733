"""Vertical velocity by the range sensor."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.sensors.height import climb
from edgeslam_torch.types import TelemetrySample

LEVEL = TelemetrySample(0.0, np.array([0.4, 0.0, 0.0]), np.zeros(3), tof_m=1.20)


@pytest.mark.parametrize(
    ("before_m", "after_m", "reported_m_s", "found_m_s"),
    [
        (1.20, 1.21, 0.0, 0.1),
        (1.20, 1.17, -0.2, -0.3),
        (1.20, 0.45, 0.0, math.nan),  # a table passes below
        (0.10, 0.10, 0.3, math.nan),  # on the ground, as the sensor says it
        (65.53, 65.53, 0.3, math.nan),  # out of its range
        (math.nan, 1.20, 0.0, math.nan),
    ],
)
def test_two_ranges_give_a_velocity_unless_the_floor_steps_or_they_are_none(before_m, after_m, reported_m_s, found_m_s):
    velocity = np.array([0.4, 0.0, reported_m_s])
    after = replace(LEVEL, stamp_s=0.1, velocity_m_s=velocity, tof_m=after_m)
    assert climb(replace(LEVEL, tof_m=before_m), after, 0.1) == pytest.approx(found_m_s, nan_ok=True)


def test_a_gap_and_a_leaning_drone_give_none():
    later = replace(LEVEL, stamp_s=0.1, tof_m=1.21)
    assert math.isnan(climb(None, later, 0.1)) and math.isnan(climb(later, LEVEL, 0.1))
    assert math.isnan(climb(LEVEL, replace(later, stamp_s=1.0), 0.1))
    assert math.isnan(climb(LEVEL, replace(later, rpy_rad=np.array([0.0, 0.7, 0.0])), 0.1))
