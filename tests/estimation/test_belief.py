"""Estimates that contradict each other are not averaged: the less plausible one is dropped and reported."""

import itertools
import math

import pytest

from edgeslam_torch.estimation.scale.belief import ScaleBelief, contradict, decide, mean
from edgeslam_torch.types import Units


def by(value, sigma, source):
    return ScaleBelief(math.log(value), sigma, source)


@pytest.mark.parametrize(
    ("beliefs", "used"),
    [
        ([], ""),
        ([by(3.0, 0.02, "telemetry"), by(3.05, 0.05, "height"), by(2.6, 0.15, "depth")], "telemetry+height+depth"),
        ([by(2.92, 0.02, "telemetry"), by(3.06, 0.04, "height"), by(0.92, 0.15, "depth")], "telemetry+height"),
        ([by(1.7, 0.02, "telemetry"), by(1.0, 0.16, "depth")], "telemetry"),
        ([by(10.0, 0.02, "telemetry"), by(1.0, 0.16, "depth")], ""),
        ([by(10.0, 0.03, "telemetry"), by(1.05, 0.05, "height"), by(1.1, 0.2, "depth")], "height+depth"),
        ([by(10.0, 0.03, "telemetry"), by(1.05, 0.05, "height"), by(9.0, 0.2, "depth")], "telemetry+depth"),
        ([by(10.0, 0.03, "telemetry"), by(1.05, 0.05, "height"), by(3.3, 0.1, "depth")], ""),
        ([by(10.0, 0.03, "telemetry"), by(1.05, 0.05, "height")], ""),
        ([by(1.15, 0.02, "telemetry"), by(1.0, 0.02, "height")], "telemetry+height"),
        ([by(1.3, 0.02, "telemetry"), by(1.28, 0.02, "height"), by(1.0, 0.02, "atlas")], "telemetry+height"),
        ([by(1.0, 0.02, "imu"), by(1.5, 0.02, "telemetry")], "imu"),
        ([by(1.0, 0.02, "imu"), by(1.02, 0.02, "telemetry"), by(3.0, 0.02, "height")], "imu+telemetry"),
    ],
)
def test_the_largest_group_that_agrees_is_used(beliefs, used):
    decided = decide(beliefs)
    assert "+".join(b.source for b in decided.used) == used
    left_out = {b.source for b in beliefs} - set(used.split("+"))
    assert decided.rejected == left_out
    apart = any(contradict(a, b) for a, b in itertools.combinations(beliefs, 2))
    assert (decided.warning is not None) == apart


def test_network_out_of_domain_is_unused_but_still_detects_gross_errors():
    network = by(0.07, 0.6, "depth")
    assert decide([network], only_witness=True).used == ()
    right = by(0.2, 0.01, "telemetry")
    assert decide([right, network], only_witness=True).used == (right,)
    assert decide([by(2.0, 0.01, "telemetry"), network], only_witness=True).used == ()


def test_limits_are_sigmas_of_the_difference():
    one = ScaleBelief(0.0, 0.03, "telemetry")
    assert not contradict(one, ScaleBelief(0.148, 0.04, "height"))
    assert contradict(one, ScaleBelief(-0.152, 0.04, "height"))


def test_the_average_is_weighted_with_all_sources_named():
    fused = mean(
        [ScaleBelief(0.0, 0.01, "telemetry"), ScaleBelief(0.02, 0.02, "height"), ScaleBelief(0, 0.09, "depth")]
    )
    assert fused.log_scale == pytest.approx(0.004, abs=0.001)
    assert fused.source == "telemetry+height+depth"
    assert fused.estimate.units is Units.METRES
    assert fused.sigma < 0.01


def test_a_third_estimate_widens_two_that_agree_less_than_one():
    sensors = mean([ScaleBelief(0.0, 0.06, "telemetry"), ScaleBelief(0.0, 0.06, "height")])
    network = ScaleBelief(0.3, 0.12, "depth")  # 2.357 sigmas off
    assert mean([sensors, network]).sigma == pytest.approx(0.04 * 2.357, rel=0.01)
    assert mean([sensors, network], inside=1).sigma == pytest.approx(0.04 * math.sqrt((1 + 2.357**2) / 2), rel=0.01)
