"""A camera half a metre ahead of the body's centre: lever-arm motion is neither translation nor climb."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swung import at_once, replay, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate

FAR = camera_on_body(forward_m=0.5)


def carried(motion, position_m, yaw, pitch):
    """The camera on a body with positions ``(N, 3)`` and angles ``(N,)``."""
    T_w_b = np.tile(np.eye(4), (len(motion.stamps_s), 1, 1))
    angles = np.stack([yaw, pitch, 0.0 * yaw], axis=1)
    T_w_b[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T_w_b[:, :3, 3] = position_m
    return replace(motion, T_w_c=T_w_b @ FAR)


def fused(rng, motion, change=lambda sample: sample):
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, FAR, faults=EXACT).samples()
    fusion, gauge = MotionFusion(FusionConfig(delay_s=0.0), FAR), motion.in_gauge(rng)
    at_once(fusion, motion, gauge, [change(s) for s in samples])
    return fusion, gauge


@pytest.fixture
def looking_round():
    """Half a metre to and fro, looking 45 degrees to either side: the camera swings by 35 cm more or less than that."""
    motion = swinging(24.0)
    t = motion.stamps_s
    p = np.stack([0.25 * np.sin(1.7 * t), 0.25 * np.sin(1.3 * t), 1.2 + 0.1 * np.sin(0.9 * t)], axis=1)
    return carried(motion, p, 0.8 * np.sin(1.3 * t), 0.0 * t)


def test_turning_does_not_change_the_scale_from_velocities(rng, looking_round):
    def without_heights(s):
        return replace(s, tof_m=np.nan, height_m=np.nan, baro_m=np.nan)

    fusion, gauge = fused(rng, looking_round, without_heights)
    assert fusion.scale().source == "telemetry"
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.02)


def test_nodding_is_no_climb(rng):
    """Up and down by 30 cm while the nose goes up and down by 15 degrees: the camera rises by 12 cm of that more."""
    motion = swinging(24.0)
    t = motion.stamps_s
    p = np.stack([0.0 * t, 0.0 * t, 1.2 + 0.3 * np.sin(0.6 * t)], axis=1)
    fusion, gauge = fused(rng, carried(motion, p, 0.0 * t, -0.26 * np.sin(0.6 * t)))
    assert fusion.statistics()["scale height"] == pytest.approx(gauge.scale, rel=0.03)


def test_a_camera_that_turns_while_it_is_lost_is_predicted_on_its_arc(rng, looking_round):
    """0.8 s without an image, 30 degrees: 27 cm of arc that no velocity tells of."""
    stamps, gauge = looking_round.stamps_s, looking_round.in_gauge(rng)
    samples = simulate(rng, stamps, looking_round.T_w_c, FAR, faults=EXACT).samples()
    fusion = MotionFusion(FusionConfig(delay_s=0.0), FAR)
    replay(fusion, replace(looking_round, stamps_s=stamps[stamps < 19.0]), gauge, samples)
    fusion.add_telemetry([s for s in samples if 18.95 < s.stamp_s < 20.0])
    at = int(np.searchsorted(stamps, 19.8))
    predicted = fusion.predict(float(stamps[at]))
    off_m = gauge.scale * np.linalg.norm(predicted.T_w_c[:3, 3] - gauge.T_m_c[at, :3, 3])
    moved_m = gauge.scale * np.linalg.norm(gauge.T_m_c[at, :3, 3] - gauge.T_m_c[at - 16, :3, 3])
    assert moved_m > 0.2
    assert off_m < 0.04
