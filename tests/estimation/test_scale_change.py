"""A scale that goes along with a map which refinement enlarges."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.telemetry.scale_change import grown
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate

T_B_C = camera_on_body()


def steps(count=20, way=0.2, sigma=0.01):
    """One displacement a second."""
    t = np.arange(float(count))
    moved = np.column_stack([np.full(count, way), np.zeros((count, 2))])
    turn = np.tile(np.eye(3), (count, 1, 1))
    return Displacements(t, t + 1.0, moved, np.full(count, sigma), turn, turn)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.3])
def test_scale_change_is_the_ratio_of_sizes(factor):
    before = steps()
    after = replace(before, moved=factor * before.moved)
    assert grown(before, after, 20.0) == pytest.approx(factor, rel=1e-12)


def test_recent_poses_do_not_affect_the_scale_change():
    before = steps()
    moved = before.moved * np.where(before.to_s > 15.0, 1.5, 1.02)[:, None]
    assert grown(before, replace(before, moved=moved), 20.0) == pytest.approx(1.02, rel=1e-12)


def test_local_corrections_do_not_affect_the_scale_change():
    """A drone that hovers, two of whose few displacements are mended when pieces are joined, the longest by a third."""
    before = steps(16, way=0.03, sigma=0.002)
    before.moved[5, 0] = 0.045
    after = before.moved.copy()
    after[5, 0], after[9, 0] = 0.03, 0.021
    assert grown(before, replace(before, moved=after), 21.0) == 1.0


@pytest.mark.parametrize("before", [steps(way=0.04), steps(count=8), steps(count=0)])
def test_noise_and_a_new_map_give_no_scale_change(before):
    assert grown(before, replace(before, moved=2.0 * before.moved), 8.0) == 1.0


@pytest.mark.parametrize("factor", [0.0, np.nan, np.inf])
def test_collapsed_map_gives_no_scale_change(factor):
    before = steps()
    assert grown(before, replace(before, moved=np.full_like(before.moved, factor)), 20.0) == 1.0


def test_other_intervals_are_refused():
    with pytest.raises(ValueError, match="20 intervals were 19"):
        grown(steps(20), steps(19), 20.0)


def test_between_two_fits_the_scale_goes_along_with_the_map(rng, swinging):
    """Soon after a fit all of the map becomes larger by a twentieth; the next fit is seconds away."""
    motion = swinging(30.0)
    gauge = motion.in_gauge(rng)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults()).samples()
    fusion, size, told = MotionFusion(FusionConfig(), T_B_C), [1.0], []

    def larger(T):
        return np.concatenate([np.concatenate([T[:, :3, :3], size[0] * T[:, :3, 3:]], axis=2), T[:, 3:]], axis=1)

    def refined(since_s):
        seen = (motion.stamps_s >= since_s) & (motion.stamps_s <= now)
        return motion.stamps_s[seen], larger(gauge.T_m_c[seen])

    fusion.refined_poses = refined
    fed = 0
    for now, T in zip(motion.stamps_s, gauge.T_m_c, strict=True):
        arrived = [s for s in samples[fed:] if s.stamp_s <= now]
        fed += len(arrived)
        fusion.add_telemetry(arrived)
        before = fusion.scale().value
        fusion.add_visual(now, larger(T[None])[0], gauge.sigma_t, gauge.sigma_r)
        after = fusion.scale().value
        if size[0] == 1.0 and now > 20.0 and after != before:  # it has just been fitted
            size[0], at_s = 1.05, now
        elif size[0] > 1.0:
            told.append((now - at_s, math.log(after / before)))
    changes = [(age, change) for age, change in told if change != 0.0]
    assert changes[0][0] == pytest.approx(1.0, abs=0.06)
    assert changes[0][1] == pytest.approx(-math.log(1.05), abs=0.003)
    assert abs(math.log(fusion.scale().value * 1.05 / gauge.scale)) < 0.05
