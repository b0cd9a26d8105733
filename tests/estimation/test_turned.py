"""The rotation that a drone's attitude tells of a frame, in a map with axes of its own, against the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import simulate

T_B_C = camera_on_body()
PROVEN_S = 12.0
"""Time after which a swung camera's turns have proven attitude."""


def asked(rng, motion, replay, samples_of=lambda samples: samples, untracked_s=(math.inf, math.inf), delay_s=None):
    """Angles [rad] of what is told from `PROVEN_S` on to the truth, each with its doubt; None where nothing is told."""
    gauge = motion.in_gauge(rng)
    fusion, found = MotionFusion(FusionConfig(delay_s=delay_s), T_B_C), []

    def each(t, i):
        told = fusion.orientation.turned(t) if t > PROVEN_S else None
        off = None if told is None else Rotation.from_matrix(told[0] @ gauge.T_m_c[i, :3, :3]).magnitude()
        found.append((t, None if told is None else (off, told[1])))

    samples = samples_of(simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples())
    replay(fusion, motion, gauge, samples, lambda t: not untracked_s[0] < t < untracked_s[1], each)
    return [told for t, told in found if t > PROVEN_S]


def test_it_is_the_cameras_to_a_degree_and_the_doubt_about_its_moment(rng, swinging, replay):
    told = asked(rng, swinging(24.0), replay)
    assert all(one is not None for one in told[:-20])  # the last half second's telemetry is still to come
    off, doubt = np.array([one for one in told if one is not None]).T
    assert np.quantile(off, 0.95) < math.radians(1.2)
    assert (off < math.radians(1.5) + doubt).all()
    assert doubt.max() < math.radians(3.0)


def test_attitude_of_another_flight_tells_nothing(rng, swinging, replay):
    """Even where the delay is known beforehand."""
    motion = swinging(24.0)
    backwards = simulate(rng, motion.stamps_s, motion.T_w_c[::-1], T_B_C).samples()
    told = asked(rng, motion, replay, lambda samples: backwards, delay_s=0.5)
    assert all(one is None for one in told)


@pytest.mark.parametrize("missing", [pytest.param("silent", marks=pytest.mark.slow), "repeated"])
def test_a_moment_without_telemetry_tells_nothing(rng, swinging, replay, missing):
    def hole(samples):
        last = next(s for s in samples if s.stamp_s > 15.0 and np.abs(s.velocity_m_s).max() > 0.15)
        if missing == "silent":
            return [s for s in samples if not 15.0 < s.stamp_s < 19.0]
        return [replace(last, stamp_s=s.stamp_s) if 15.0 < s.stamp_s < 19.0 else s for s in samples]

    told = asked(rng, swinging(24.0), replay, hole)
    inside = told[round((17.5 - PROVEN_S) * 20.0) : round((19.0 - PROVEN_S) * 20.0)]
    assert all(one is None for one in inside)
    assert any(one is not None for one in told)


@pytest.mark.slow
def test_a_camera_that_was_long_lost_is_told_nothing(rng, swinging, replay):
    told = asked(rng, swinging(30.0), replay, untracked_s=(14.0, 22.0))
    after = round((20.0 - PROVEN_S) * 20.0)
    assert told[after] is None and told[after + 80] is not None
