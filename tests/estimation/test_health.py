import math
from dataclasses import replace

import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.belief import disagreement
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate
from edgeslam_torch.types import Health, ScaleEstimate

T_B_C = camera_on_body()
SURE = ScaleEstimate(2.0, 0.06, "telemetry+height")


def test_disagreement_counts_sigmas_of_the_difference():
    one, other = (
        ScaleEstimate(2.0, 0.06, "telemetry"),
        ScaleEstimate(2.0 * math.exp(0.2), 0.08 * math.exp(0.2), "depth"),
    )
    assert disagreement([one, other]) == pytest.approx(0.2 / math.hypot(0.03, 0.04))
    assert disagreement([one, other, one]) == pytest.approx(disagreement([other, one]))
    assert disagreement([one]) == disagreement([]) == 0.0


def test_the_status_line_names_problems_only():
    good = Health(9.0, "tracking", True, SURE, telemetry_age_s=0.1, battery=0.63)
    assert str(good) == "metres to 3 %, battery 63 %"
    assert str(replace(good, metric=False)) == "no metres, battery 63 %"
    bad = replace(good, telemetry_age_s=4.2, disagreement=7.0, battery=math.nan)
    assert str(bad) == "metres to 3 %, sources differ by 7 sigmas, no telemetry for 4.2 s"
    apart = replace(good, submap_sigma=0.3, drift_sigma=0.4)
    assert str(apart) == "metres to 3 %, position sigma 0.5 m from the start, battery 63 %"
    lone = str(replace(good, submap_sigma=math.inf))
    assert lone == "metres to 3 %, submap unrelated to where the flight began, battery 63 %"
    assert str(Health(9.0, "tracking", True, SURE)) == "metres to 3 %", "no drone, no word of it"


def test_health_of_a_flight_and_of_its_silence(rng, swinging, replay):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults(video_delay_s=0.4)).samples()
    fusion = MotionFusion(FusionConfig(), T_B_C)
    before = fusion.health(0.0, "starting", False)
    assert (before.telemetry_age_s, before.filtering, before.sources) == (math.inf, False, ())
    assert math.isnan(before.battery)
    assert math.isnan(before.delay_s)
    replay(fusion, motion, motion.in_gauge(rng), [s for s in samples if s.stamp_s < 15.0])
    last = max((s for s in samples if s.stamp_s < 15.0), key=lambda s: s.stamp_s)
    health = fusion.health(20.0, "tracking", True)
    assert health.telemetry_age_s == pytest.approx(20.0 - last.stamp_s)
    assert health.battery == last.battery
    assert health.delay_s == pytest.approx(0.4, abs=0.05)
    assert {s.source for s in health.sources} == {"telemetry", "height"}
    assert health.scale == fusion.scale()
    assert health.disagreement < 3.0
    assert health.doubts == ()


def test_telemetry_of_another_flight_is_a_doubt(rng, swinging, replay):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples()
    wild = [replace(s, velocity_m_s=rng.normal(0.0, 0.4, 3)) for s in samples]
    fusion = MotionFusion(FusionConfig(), T_B_C)
    replay(fusion, motion, motion.in_gauge(rng), wild)
    health = fusion.health(20.0, "tracking", False)
    assert any("velocities are not used" in doubt for doubt in health.doubts)
    assert not health.filtering
    assert (health.scale.source, health.scale.sigma) == ("none", math.inf)
