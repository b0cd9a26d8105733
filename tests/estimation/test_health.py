import math

import pytest
from swung import T_B_C, at_once, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.belief import disagreement
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate
from edgeslam_torch.types import ScaleEstimate


def test_disagreement_counts_sigmas_of_the_difference():
    one, other = (
        ScaleEstimate(2.0, 0.06, "telemetry"),
        ScaleEstimate(2.0 * math.exp(0.2), 0.08 * math.exp(0.2), "depth"),
    )
    assert disagreement([one, other]) == pytest.approx(0.2 / math.hypot(0.03, 0.04))
    assert disagreement([one, other, one]) == pytest.approx(disagreement([other, one]))
    assert disagreement([one]) == disagreement([]) == 0.0


def test_health_of_a_flight_and_of_its_silence(rng):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults(video_delay_s=0.4)).samples()
    fusion = MotionFusion(FusionConfig(), T_B_C)
    before = fusion.health(0.0, "starting", False)
    assert (before.telemetry_age_s, before.filtering, before.sources) == (math.inf, False, ())
    assert math.isnan(before.battery)
    assert math.isnan(before.delay_s)
    at_once(fusion, motion, motion.in_gauge(rng), [s for s in samples if s.stamp_s < 15.0])
    last = max((s for s in samples if s.stamp_s < 15.0), key=lambda s: s.stamp_s)
    health = fusion.health(20.0, "tracking", True)
    assert health.telemetry_age_s == pytest.approx(20.0 - last.stamp_s)
    assert health.battery == last.battery
    assert health.delay_s == pytest.approx(0.4, abs=0.05)
    assert {s.source for s in health.sources} == {"telemetry", "height"}
    assert health.scale == fusion.scale()
    assert health.disagreement < 3.0
    assert health.doubts == ()
