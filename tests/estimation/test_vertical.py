"""The vertical that a drone's attitude tells of a young map."""

import math

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.telemetry.sensor_validation import Agreement, Reading
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.noise import DELAY_S
from edgeslam_torch.types import TelemetrySample

T_B_C = camera_on_body(0.0)
"""A camera that looks along the body's x axis, its y axis down."""


def told(pitch_rad, upright=True, delay_s=0.0):
    """Fusion that has heard of a drone with a nose this far down, the same all the time or ``(N,)`` every 0.1 s."""
    fusion = MotionFusion(FusionConfig(delay_s=delay_s), T_B_C)
    fusion.orientation.began_upright = upright
    for k, pitch in enumerate(np.broadcast_to(pitch_rad, 30)):
        rpy = np.array([0.0, float(pitch), 1.0])
        fusion.add_telemetry([TelemetrySample(0.1 * k, np.zeros(3), rpy, battery=1.0)])
    return fusion


def test_a_nose_that_is_down_sees_up_behind_and_above():
    up_c, doubt_rad = told(math.radians(10.0)).vertical(1.0)
    np.testing.assert_allclose(up_c, [0.0, -math.cos(math.radians(10.0)), -math.sin(math.radians(10.0))], atol=1e-9)
    assert doubt_rad == pytest.approx(0.0, abs=1e-12)


def test_vertical_compensates_the_video_delay():
    pitch = np.where(np.arange(30) < 10, 0.0, math.radians(10.0))
    before, after = (told(pitch, delay_s=delay_s).vertical(1.2)[0] for delay_s in (0.5, 0.0))
    assert before[2] == pytest.approx(0.0, abs=1e-9) and after[2] < -0.17


def test_strong_lean_needs_validated_attitude_for_the_vertical():
    fusion = told(np.where(np.arange(30) < 20, 0.0, math.radians(20.0)))
    assert fusion.vertical(1.0) is None
    fusion.flight.trust.judge(Reading.ATTITUDE, Agreement(0.99, 30))
    assert fusion.vertical(1.0)[1] == pytest.approx(0.0, abs=1e-9)


def test_vertical_error_covers_delay_uncertainty():
    fusion = told(np.radians(np.clip(20.0 * (0.1 * np.arange(30) - 1.0), 0.0, 10.0)), delay_s=None)
    late_s = min(fusion.flight.delay_sigma_s, DELAY_S)
    leaned = fusion.vertical(1.25 + fusion.delay_s)[1]
    assert math.degrees(leaned) == pytest.approx(20.0 * min(late_s, 0.25), rel=0.05)
