"""A map that shrinks while it is made, against the scale with which it was made."""

from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.depth_scale import compared
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate

T_B_C = camera_on_body()
GROWN = 1.6
"""How much metres per map unit grow between 12 and 17 s."""


def flown(rng, swinging, grown, until_s=34.0):
    motion = swinging(until_s, 12.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples()
    scale = 0.8 * grown ** np.clip((motion.stamps_s - 12.0) / 5.0, 0.0, 1.0)
    T_m_c = motion.T_w_c.copy()
    steps = np.diff(motion.T_w_c[:, :3, 3], axis=0) / scale[1:, None]
    T_m_c[:, :3, 3] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    fusion, said, told = MotionFusion(FusionConfig(delay_s=0.5), T_B_C), [], 0
    for i, stamp_s in enumerate(motion.stamps_s.tolist()):
        first, told = told, sum(s.stamp_s <= stamp_s for s in samples[told:]) + told
        fusion.add_telemetry(samples[first:told])
        fusion.add_visual(stamp_s, T_m_c[i], 0.003, 0.002)
        if any("drifted" in doubt for doubt in fusion.health(stamp_s, "tracking", True).doubts):
            said.append(stamp_s)
    return fusion, said


def test_each_part_of_a_flight_has_its_own_scale(rng, swinging):
    fusion, _ = flown(rng, swinging, GROWN)
    for stamp_s, truth in ((6.0, 0.8), (28.0, 0.8 * GROWN)):
        here = fusion.scale_around(stamp_s)
        assert here is not None
        assert here.value == pytest.approx(truth, rel=0.05)
        assert abs(here.value - truth) < 3.0 * here.sigma


def test_a_drifted_map_says_so(rng, swinging):
    fusion, said = flown(rng, swinging, GROWN)
    assert said
    assert 17.0 < said[0] < 34.0
    assert any("drifted" in words for words in fusion.warnings())


def test_a_map_of_one_scale_says_nothing(rng, swinging):
    fusion, said = flown(rng, swinging, 1.0)
    assert not said
    assert not any("drifted" in words for words in fusion.warnings())


def test_nothing_is_told_without_telemetry_or_before_the_flight(rng, swinging):
    assert MotionFusion(FusionConfig(), T_B_C).scale_around(3.0) is None
    fusion, _ = flown(rng, swinging, 1.0, 12.0)
    assert fusion.scale_around(-100.0) is None
    assert fusion.scale_around(-np.inf) is None


def test_some_frames_of_a_flight_have_a_scale_of_their_own(rng, swinging):
    """Whatever is remembered of them: a piece of map may be older than the displacements that are kept."""
    fusion, _ = flown(rng, swinging, GROWN)
    motion = swinging(34.0, 12.0)
    early = motion.stamps_s < 11.0
    T_m_c = motion.T_w_c[early].copy()
    T_m_c[:, :3, 3] /= 0.7
    told = fusion.scale_along(motion.stamps_s[early], T_m_c)
    assert told is not None
    assert told.value == pytest.approx(0.7, rel=0.05)
    assert abs(told.value - 0.7) < 3.0 * told.sigma
    assert fusion.scale_along(motion.stamps_s[:0], T_m_c[:0]) is None
    assert fusion.scale_along(motion.stamps_s[early] + 1e3, T_m_c) is None
    assert MotionFusion(FusionConfig(), T_B_C).scale_along(motion.stamps_s[early], T_m_c) is None


def test_readings_that_are_cut_off_are_made_up_for(rng, swinging):
    """A drone that truncates reads half a step low: at .3 m/s a sixth, and so would a scale by them."""
    motion = swinging(34.0, 12.0)
    exact = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    steps = [10.0 * s.velocity_m_s + rng.normal(0.0, 0.2, 3) for s in exact]
    samples = [replace(s, velocity_m_s=0.1 * np.trunc(step)) for s, step in zip(exact, steps, strict=True)]
    fusion = MotionFusion(FusionConfig(delay_s=0.0, velocity_rounding="truncate"), T_B_C)
    told = 0
    for i, stamp_s in enumerate(motion.stamps_s.tolist()):
        first, told = told, sum(s.stamp_s <= stamp_s for s in samples[told:]) + told
        fusion.add_telemetry(samples[first:told])
        fusion.add_visual(stamp_s, motion.T_w_c[i], 0.003, 0.002)
    for found in (fusion.scale_around(17.0), fusion.scale_along(motion.stamps_s, motion.T_w_c)):
        assert found.value == pytest.approx(1.0, rel=0.05)


def test_the_networks_unit_is_what_it_told_of_the_map(rng):
    fusion = MotionFusion(FusionConfig(), T_B_C)
    assert fusion.metres.network_unit() is None
    depth = rng.uniform(1.0, 4.0, 50)
    for _ in range(5):
        fusion.metres.add_depth_ratio(compared(0.6 * depth, depth))
    assert fusion.metres.network_unit() == pytest.approx(0.6)
