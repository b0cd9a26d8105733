"""How late the video is."""

from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate

T_B_C = camera_on_body()
DELAY_S = 0.5


@pytest.mark.parametrize("seed", [0, 1])
def test_noisy_attitude_gives_the_delay_for_any_packet_phase(swinging, replay, seed):
    """Half a degree of noise: an attitude between two packets has less, which must not draw the delay to it."""
    rng = np.random.default_rng(seed)
    motion = swinging(20.0)
    told = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults(video_delay_s=0.4)).samples()
    noisy = [replace(sample, rpy_rad=sample.rpy_rad + rng.normal(0.0, 0.01, 3)) for sample in told]
    fusion = MotionFusion(FusionConfig(), T_B_C)
    replay(fusion, motion, motion.in_gauge(rng), noisy)
    assert fusion.delay_s == pytest.approx(0.4, abs=0.008)
