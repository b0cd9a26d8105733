"""A map that is still being rescaled by its refinement, and the sigma of metres told meanwhile."""

import math

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.telemetry.scale_convergence import ScaleConvergence
from edgeslam_torch.estimation.telemetry.visual_memory import Sightings
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate

T_B_C = camera_on_body()
AS_MUCH_AGAIN = 1.3


def path(until_s, scale=1.0, way=1.0):
    """Poses along a way of one unit a second."""
    t = np.arange(0.0, until_s, 0.1)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3] = scale * way * t
    return Sightings(t, T, np.full(len(t), 0.01))


def rescaled(by, within_s=0.5):
    """After two comparisons, the second of which finds a map larger by a factor."""
    convergence_sigma = ScaleConvergence()
    convergence_sigma.compare(path(2.0), path(2.0), 2.0)
    convergence_sigma.compare(path(2.0 + within_s), path(2.0 + within_s, by), 2.0 + within_s)
    return convergence_sigma


@pytest.mark.parametrize("by", [1.1, 1 / 1.1])
def test_recent_rescaling_predicts_further_rescaling(by):
    assert rescaled(by).sigma == pytest.approx(AS_MUCH_AGAIN * math.log(1.1), rel=1e-6)


def test_convergence_sigma_decays_within_seconds():
    convergence_sigma = rescaled(1.1)
    before = convergence_sigma.sigma
    convergence_sigma.compare(path(3.5), path(3.5), 3.5)
    assert convergence_sigma.sigma == pytest.approx(before * math.exp(-1.0))


def test_repeated_changes_accumulate():
    convergence_sigma = rescaled(1.1)
    convergence_sigma.compare(path(3.0), path(3.0, 1.1), 3.0)
    assert convergence_sigma.sigma == pytest.approx(AS_MUCH_AGAIN * math.log(1.1) * (1.0 + math.exp(-0.5)))


def test_frames_since_the_comparison_are_ignored():
    """Only the frames after the last comparison change; and a first comparison has nothing to compare."""
    convergence_sigma = ScaleConvergence()
    convergence_sigma.compare(path(2.0), path(2.0, 1.3), 2.0)
    assert convergence_sigma.sigma == 0.0
    after = path(2.5)
    after.T[after.stamps_s > 2.0, 0, 3] += 1.0
    convergence_sigma.compare(path(2.5), after, 2.5)
    assert convergence_sigma.sigma == 0.0


def test_a_hover_has_no_size():
    convergence_sigma = ScaleConvergence()
    convergence_sigma.compare(path(2.0, way=0.01), path(2.0, way=0.01), 2.0)
    convergence_sigma.compare(path(2.5, way=0.01), path(2.5, way=0.02), 2.5)
    assert convergence_sigma.sigma == 0.0


def test_a_scale_told_by_a_map_at_unrest_is_less_sure(rng, swinging, replay):
    """Refinement enlarges all of the map by 3 % a second, and so the scale has to fall; in the end it has stopped."""
    motion = swinging(12.0)
    gauge = motion.in_gauge(rng)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults()).samples()
    sigma = {}
    for rate in (0.0, 0.03):
        fusion = MotionFusion(FusionConfig(), T_B_C)

        def refined(since_s, fusion=fusion, rate=rate):
            now = np.searchsorted(motion.stamps_s, fusion.flight.memory.last.stamp_s, side="right")
            T = gauge.T_m_c[:now].copy()
            T[:, :3, 3] *= math.exp(rate * motion.stamps_s[now - 1])
            return motion.stamps_s[:now], T

        fusion.refined_poses = refined
        replay(fusion, motion, gauge, samples)
        live = fusion.scale()
        fusion.revise(motion.stamps_s, gauge.T_m_c)
        sigma[rate] = live.sigma / live.value, fusion.scale().sigma / fusion.scale().value
    assert sigma[0.03][0] > math.hypot(sigma[0.0][0], 0.03)
    assert sigma[0.03][1] == pytest.approx(sigma[0.0][1], rel=0.05)
