"""Bias of a depth network."""

import numpy as np
import pytest

from edgeslam_torch.navigation.near.depth import ALONE_SIGMA, fit_to_points
from edgeslam_torch.navigation.near.depth_bias import DepthBias
from edgeslam_torch.types import DepthMap


def fit(rng, ratio, count=60):
    """To points whose map depth is ``ratio`` of the network's, which is wrong by a tenth."""
    network = np.full((40, 60), np.nan, np.float32)
    uv = np.stack(np.divmod(rng.permutation(2400)[:count], 40), axis=1)
    depth = rng.uniform(0.6, 4.0, count)
    network[uv[:, 1], uv[:, 0]] = depth
    noisy = ratio * depth * np.exp(0.1 * rng.standard_normal(count))
    return fit_to_points(DepthMap(network, np.zeros_like(network)), uv.astype(float), noisy)


def knows(rng, ratio=0.8, unit_m=1.0, pictures=20):
    usual = DepthBias()
    for _ in range(pictures):
        assert usual.is_consistent(fit(rng, ratio / unit_m), unit_m, sure=True)
    return usual


def test_fit_yields_the_depth_ratio_for_any_slope(rng):
    assert fit(rng, 0.8).ratio_log == pytest.approx(np.log(0.8), abs=0.05)


def test_bias_line_is_in_map_units(rng):
    usual = knows(rng, unit_m=2.0)
    for unit_m in (2.0, 0.5):
        line = usual.line(unit_m)
        assert np.exp(line.offset) * unit_m == pytest.approx(0.8, rel=0.04)
        assert line.slope == pytest.approx(1.0, abs=0.03) and line.points == 0
        assert line.sigma_log == ALONE_SIGMA


def test_points_at_another_scale_are_rejected(rng):
    usual = knows(rng)
    assert usual.is_consistent(fit(rng, 0.8 * 1.25), 1.0, sure=True), "pictures differ"
    for ratio in (0.8 * 1.8, 0.8 / 1.8):
        assert not usual.is_consistent(fit(rng, ratio), 1.0, sure=True)
    assert np.exp(usual.line(1.0).offset) == pytest.approx(0.8, rel=0.04), "nor remembered"


def test_bias_needs_seconds_of_certain_scale(rng):
    usual = knows(rng, pictures=10)
    assert usual.line(1.0) is None
    assert usual.is_consistent(fit(rng, 2.4), 1.0, sure=False)
    for _ in range(30):
        usual.is_consistent(fit(rng, 0.8), 1.0, sure=False)
    assert usual.line(1.0) is None


def test_persistent_outliers_reset_the_bias(rng):
    """The metres that it rested on were wrong, and are right now."""
    usual = knows(rng)
    consistent = [usual.is_consistent(fit(rng, 2.4), 1.0, sure=True) for _ in range(120)]
    assert not any(consistent[:70]) and all(consistent[-30:])
    assert np.exp(usual.line(1.0).offset) == pytest.approx(2.4, rel=0.04)


def test_an_inlier_resets_the_outlier_count(rng):
    usual = knows(rng)
    for _ in range(3):
        for _ in range(60):
            assert not usual.is_consistent(fit(rng, 2.4), 1.0, sure=True)
        assert usual.is_consistent(fit(rng, 0.8), 1.0, sure=True)


def test_wall_points_do_not_correct_the_room_behind_the_door(rng):
    """A network with a wall 1.3 times too far, and the room right: the wall is mended, the room stays."""
    network = np.full((120, 160), 2.4, np.float32)
    network[:, :70] = 1.3
    network = network * np.exp(0.03 * rng.standard_normal(network.shape)).astype(np.float32)
    uv = rng.integers([0, 0], [70, 120], (300, 2)).astype(float)
    depth = DepthMap(network, np.zeros_like(network))
    own = fit_to_points(depth, uv, np.ones(300))
    told = knows(rng, 1.0).line(1.0).through(own).applied(depth)
    assert np.median(told.depth_m[:, 5:60]) == pytest.approx(1.0, rel=0.06)
    assert np.median(told.depth_m[:, 110:]) == pytest.approx(2.4, rel=0.06)
    assert np.median(own.applied(depth).depth_m[:, 110:]) < 2.0, "by its own line it is a fifth nearer"


def test_frame_with_points_is_more_certain_away_from_them_than_without(rng):
    """But not as sure as beside them."""
    usual = knows(rng, 1.0)
    network = np.full((120, 160), 1.0, np.float32)
    depth = DepthMap(network, np.zeros_like(network))
    uv = rng.integers([0, 0], [50, 120], (300, 2)).astype(float)
    sigma = usual.line(1.0).through(fit_to_points(depth, uv, np.ones(300))).applied(depth).sigma_log
    assert np.median(sigma[:, 5:45]) < 0.1
    assert np.median(sigma[:, 120:]) == pytest.approx(0.2, abs=0.01)
    assert np.median(usual.line(1.0).applied(depth).sigma_log) == pytest.approx(0.3, abs=0.01)


def test_points_at_all_depths_bend_the_line_everywhere(rng):
    """A network that compresses depth, unlike the bias line."""
    true = rng.uniform(0.6, 5.0, (120, 160)).astype(np.float32)
    depth = DepthMap(1.2 * true**0.8, np.zeros_like(true))
    uv = rng.integers([0, 0], [160, 120], (800, 2)).astype(float)
    z = true[uv[:, 1].astype(int), uv[:, 0].astype(int)].astype(float)
    told = knows(rng, 1.0).line(1.0).through(fit_to_points(depth, uv, z)).applied(depth)
    error = np.abs(np.log(told.depth_m / true))
    assert np.median(error) < 0.05 < np.median(np.abs(np.log(depth.depth_m / true)))


def test_bias_slope_comes_from_frames_with_a_wide_depth_range(rng):
    usual = DepthBias()
    for _ in range(20):
        true = rng.uniform(0.6, 5.0, (40, 60)).astype(np.float32)
        uv = rng.integers([0, 0], [60, 40], (200, 2)).astype(float)
        z = true[uv[:, 1].astype(int), uv[:, 0].astype(int)].astype(float)
        assert usual.is_consistent(fit_to_points(DepthMap(1.2 * true**0.8, np.zeros_like(true)), uv, z), 1.0, sure=True)
    line = usual.line(1.0)
    assert line.slope == pytest.approx(1.25, abs=0.04)
    assert line.offset + line.slope * np.log(1.2 * 2.0**0.8) == pytest.approx(np.log(2.0), abs=0.08)
