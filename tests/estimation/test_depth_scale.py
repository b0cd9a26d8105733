"""The depth network's scale: whether its error lies inside its sigma, in worlds that know nothing of the formula."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.scale.depth_scale import DepthRatio, DepthRatios, compared

LEAST = 0.1


def scene(rng, network, keyframes=40, points=300):
    """Log error of the scale and its sigma in one scene with one network.

    A scene has a mean log depth and a spread around it, both of which differ from view to view. A network pulls log
    depth towards the mean of the rooms it was trained in (1.6 m), has an error for each region and each picture, and
    noise for each pixel. The map has a scale of its own and noise in its depths.
    """
    follows, regions, pictures = network
    mean, log_scale = rng.normal(math.log(2.2), 0.55), rng.uniform(-1.0, 1.0)
    ratios = DepthRatios(LEAST)
    for _ in range(keyframes):
        depth = mean + rng.normal(0, 0.15) + rng.normal(0, rng.uniform(0.15, 0.35), points)
        error = (
            np.repeat(rng.normal(0, regions, 6), points // 6) + rng.normal(0, pictures) + rng.normal(0, 0.03, points)
        )
        network_log = follows * depth + (1 - follows) * math.log(1.6) + error
        map_log = depth - log_scale + rng.normal(0, 0.02, points)
        ratios.add(compared(np.exp(network_log), np.exp(map_log)))
    scale = ratios.scale()
    return scale.log_scale - log_scale, scale


def draws(rng, count, follows):
    """Scenes with networks of all kinds: what is unknown about a view is unknown about the next view in part."""
    out = []
    for _ in range(count):
        network = rng.uniform(*follows), rng.uniform(0.0, 0.2), rng.uniform(0.0, 0.2)
        out.append(scene(rng, network))
    return np.array([error for error, _ in out]), [s for _, s in out]


@pytest.mark.parametrize("follows", [(0.8, 1.0), pytest.param((-0.1, 0.4), marks=pytest.mark.slow)])
def test_truth_lies_inside_two_sigmas(rng, follows):
    error, scales = draws(rng, 60, follows)
    sigma = np.array([s.sigma for s in scales])
    assert np.mean(np.abs(error) <= 2 * sigma) >= 0.95
    assert np.mean(np.abs(error) <= 0.1 * sigma) < 0.5  # and sigma is not simply huge


@pytest.mark.parametrize("level", [0.1, 1.0, 30.0])
def test_depth_that_has_nothing_to_do_with_the_scene_is_out_of_domain(rng, level):
    """Weights of random noise: every pixel some depth or other, smooth or not, or one and the same everywhere."""
    kinds = (
        lambda: level * np.exp(rng.normal(0, 0.4, 300)),
        lambda: level * np.exp(np.repeat(rng.normal(0, 0.4, 6), 50)),
        lambda: np.full(300, level),
    )
    for network in kinds:
        ratios = DepthRatios(LEAST)
        for _ in range(30):
            ratios.add(compared(network(), np.exp(rng.normal(rng.normal(0.7, 0.15), 0.3, 300))))
        scale = ratios.scale()
        assert not scale.in_domain
        assert "out of its domain" in scale.warning()
        assert f"slope {scale.slope:.2f}" in scale.warning()


def test_a_scene_of_one_depth_proves_no_network(rng):
    """Slope is not read from the map's noise: a wall as far as the network's mean would pass for known."""
    ratios, known = DepthRatios(LEAST), DepthRatios(LEAST)
    for _ in range(30):
        for held, depth_spread in ((ratios, 0.01), (known, 0.3)):
            z = np.exp(0.5 + rng.normal(0, depth_spread, 300))
            held.add(compared(z * np.exp(rng.normal(0, 0.02, 300)), z))
    assert ratios.scale().slope < 0.2
    assert known.scale().slope > 0.9
    assert ratios.scale().sigma > 1.5 * known.scale().sigma


def test_each_sign_of_doubt_widens(rng):
    ratio = DepthRatio(0.3, 0.05, 0.9)

    def sigma(ratios):
        held = DepthRatios(LEAST)
        for r in ratios:
            held.add(r)
        return held.scale().sigma

    best = sigma([ratio] * 20)
    assert sigma([replace(ratio, slope=0.3)] * 20) > 1.1 * best
    assert sigma([replace(ratio, slope=1.7)] * 20) > 1.1 * best
    assert sigma([replace(ratio, spread_log=0.2)] * 20) > 1.5 * best
    assert sigma([replace(ratio, log_ratio=x) for x in rng.normal(0.3, 0.3, 20)]) > 1.1 * best


def test_wild_anchors_do_not_bend_the_slope(rng):
    z = np.exp(rng.normal(0.5, 0.3, 300))
    network = 1.2 * z**0.7
    network[:20] = 0.1
    assert compared(network, z).slope == pytest.approx(0.7, abs=0.03)
