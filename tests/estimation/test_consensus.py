"""Inconsistent estimates are not averaged: the less plausible one is dropped and reported."""

import math

import numpy as np
import pytest

from edgeslam_torch.estimation.scale.consensus import at_odds, contradict, settled_with_network, sided_with
from edgeslam_torch.estimation.scale.log_scale import LogScale, fuse


def opinion(value, sigma, source):
    return LogScale(math.log(value), sigma, source)


def test_consistent_estimates_are_all_used():
    told, network = opinion(3.0, 0.02, "telemetry+height"), opinion(2.6, 0.15, "depth")
    settled = settled_with_network(told, network, in_domain=True)
    assert settled.used == (told, network)
    assert settled.warning is None


def test_wrong_network_is_rejected_when_two_sensors_agree():
    """Half of a real drone's flight: 2.92 by velocities, 3.06 by height, 3.02 in truth, .92 by the network."""
    told, network = opinion(2.99, 0.02, "telemetry+height"), opinion(0.92, 0.15, "depth")
    settled = settled_with_network(told, network, in_domain=True)
    scale = fuse(settled.used)
    assert scale.value == pytest.approx(3.02, rel=0.02)
    assert scale.sigma / scale.value == pytest.approx(0.02)
    assert "the network is not used" in settled.warning


def test_single_sensor_overrules_the_network_except_for_gross_errors():
    network = opinion(1.0, 0.16, "depth")
    off = settled_with_network(opinion(1.7, 0.02, "telemetry"), network, in_domain=True)
    assert [o.source for o in off.used] == ["telemetry"]
    unit = settled_with_network(opinion(10.0, 0.02, "telemetry"), network, in_domain=True)
    assert unit.used == ()
    assert "right unit" in unit.warning


def test_network_out_of_domain_is_unused_but_still_detects_gross_errors():
    network = opinion(0.07, 0.6, "depth")
    assert settled_with_network(None, network, in_domain=False).used == ()
    right = opinion(0.2, 0.01, "telemetry")
    assert settled_with_network(right, network, in_domain=False).used == (right,)
    assert settled_with_network(opinion(2.0, 0.01, "telemetry"), network, in_domain=False).used == ()


def test_contradicted_atlas_is_rejected_with_a_warning():
    settled = settled_with_network(opinion(1.3, 0.02, "telemetry+height"), opinion(1.0, 0.02, "atlas"), True)
    assert [o.source for o in settled.used] == ["telemetry+height"]
    assert "the atlas contradict" in settled.warning and "network" not in settled.warning


def test_no_estimates_give_no_scale():
    assert settled_with_network(None, None, in_domain=False).used == ()


def test_third_estimate_decides_between_two():
    fast, high = opinion(10.0, 0.03, "telemetry"), opinion(1.05, 0.05, "height")
    assert sided_with(fast, high, opinion(1.1, 0.2, "depth")) == high
    assert sided_with(fast, high, opinion(9.0, 0.2, "depth")) == fast
    assert sided_with(fast, high, opinion(3.3, 0.1, "depth")) is None
    assert sided_with(fast, high, opinion(3.3, 2.0, "depth")) is None, "a witness that knows nothing"
    assert sided_with(fast, high, None) is None


def test_limits_are_sigmas_of_the_difference():
    one = LogScale(0.0, 0.03, "telemetry")
    assert not contradict(one, LogScale(0.149, 0.04, "height"))
    assert contradict(one, LogScale(-0.151, 0.04, "height"))
    assert not at_odds(one, LogScale(math.log(1.4), 0.04, "height")), "a bent map"
    assert at_odds(one, LogScale(math.log(1.6), 0.04, "height"))
    assert not at_odds(one, LogScale(math.log(1.6), 0.2, "height"))


def test_truth_stays_inside_two_sigmas_when_networks_lie(rng):
    """One network in five is wrong by up to four times; averaging would drag the scale along in most of these."""
    inside, averaged, count = 0, 0, 2000
    for _ in range(count):
        lie = rng.uniform(-1.4, 1.4) if rng.random() < 0.2 else 0.0
        told = LogScale(rng.normal(0, 0.05), 0.05, "telemetry+height")
        network = LogScale(lie + rng.normal(0, 0.15), 0.15, "depth")
        scale = fuse(settled_with_network(told, network, in_domain=True).used)
        inside += abs(math.log(scale.value)) <= 2 * scale.sigma / scale.value
        averaged += scale.source.endswith("depth")
    assert inside / count >= 0.94
    assert 0.8 < averaged / count < 0.95
    assert np.isfinite(scale.sigma)
