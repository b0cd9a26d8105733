"""Alignment of network depth to the map."""

import numpy as np
import pytest

from edgeslam_torch.navigation.near.depth import MIN_POINTS, NearFit, fit_near, fit_to_points, local_error
from edgeslam_torch.types import DepthMap


def compressed(rng, count=200, noise=0.05, wrong=0.2):
    """A network that says 1.4 d^0.7 for d, and points of which a share is hidden by something nearer."""
    true = rng.uniform(0.4, 6.0, count)
    network = 1.4 * true**0.7 * np.exp(noise * rng.standard_normal(count))
    seen = true.copy()
    hidden = rng.random(count) < wrong
    seen[hidden] *= rng.uniform(1.5, 4.0, int(hidden.sum()))
    return network, seen


def test_a_network_that_compresses_depth_is_undone(rng):
    fit = fit_near(*compressed(rng))
    near = np.exp(fit.offset + fit.slope * np.log(1.4 * 0.5**0.7))
    assert near == pytest.approx(0.5, rel=0.15)
    far = np.exp(fit.offset + fit.slope * np.log(1.4 * 5.0**0.7))
    assert far == pytest.approx(5.0, rel=0.15)
    assert 0.03 <= fit.sigma_log < 0.3


def test_a_right_network_is_left_as_it_is(rng):
    true = rng.uniform(0.4, 6.0, 100)
    fit = fit_near(true, true)
    assert fit.slope == pytest.approx(1.0, abs=1e-6)
    assert fit.offset == pytest.approx(0.0, abs=1e-6)


def test_too_few_points_yield_no_fit(rng):
    network, seen = compressed(rng, MIN_POINTS - 1)
    assert fit_near(network, seen) is None
    assert fit_near(np.full(50, np.nan), np.ones(50)) is None


def test_points_are_compared_where_they_are_seen(rng):
    uv, z = rng.integers(0, [80, 60], (300, 2)), rng.uniform(1.0, 4.0, 300)
    depth = np.full((60, 80), np.nan, np.float32)
    depth[uv[:, 1], uv[:, 0]] = 2.0 * z
    _, last = np.unique((uv @ [1, 80])[::-1], return_index=True)  # the last of those in one pixel is in the picture
    last = 299 - last
    fit = fit_to_points(DepthMap(depth, np.full_like(depth, 0.2)), uv[last] + 0.3, z[last])
    assert np.exp(fit.offset + fit.slope * np.log(4.0)) == pytest.approx(2.0, rel=0.05)
    assert fit.residual == pytest.approx(0.0, abs=0.05)


LEVEL = np.log(2.0)


def half_seen(rng, residual, shape=(120, 160)):
    """Points in the left half of a picture, whose map depth is ``exp(residual)`` of the line's."""
    uv = rng.uniform([0, 0], [0.5 * shape[1], shape[0]], (1000, 2))
    return uv, residual + 0.02 * rng.standard_normal(1000), shape


def test_points_correct_the_line_only_locally(rng):
    uv, residual, shape = half_seen(rng, -0.4)
    error, sigma = local_error(uv, np.zeros(len(uv)), residual, 0.3, np.zeros(shape))
    assert error.shape == sigma.shape == shape
    np.testing.assert_allclose(error[20:-20, 10:60], -0.4, atol=0.1)
    np.testing.assert_allclose(error[:, -40:], 0.0, atol=0.01)
    assert sigma[:, 10:60].max() < 0.3 <= sigma[:, -40:].min() + 1e-6


def test_depth_without_points_nearby_is_as_unsure_as_the_network(rng):
    """A fit of 3 % in a room does not extend to the space behind its door."""
    uv, residual, shape = half_seen(rng, 0.0)
    fit = NearFit(0.0, 1.0, 0.03, len(uv), uv, np.full(len(uv), LEVEL), residual)
    network = DepthMap(np.full(shape, 2.0, np.float32), np.full(shape, 0.1, np.float32))
    metres = fit.applied(network)
    assert np.median(metres.sigma_log[:, 10:60]) < 0.12
    assert metres.sigma_log[:, -40:].min() >= 0.29
    np.testing.assert_allclose(metres.depth_m, 2.0, rtol=0.02)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_door_frame_does_not_correct_the_room_behind_it(rng, ratio):
    """Points all around, at another depth than that of the pixels in the middle."""
    uv, shape = rng.uniform([0, 0], [160, 120], (1500, 2)), (120, 160)
    uv = uv[np.abs(uv - [80, 60]).max(axis=1) > 16]
    log_m = np.full(shape, LEVEL)
    log_m[44:76, 64:96] += np.log(ratio)
    error, sigma = local_error(uv, np.full(len(uv), LEVEL), np.full(len(uv), -0.3), 0.1, log_m)
    assert np.abs(error[44:76, 64:96]).max() < 0.1
    assert sigma[44:76, 64:96].min() > 0.25
    assert error[:, :50].max() < -0.2
    assert sigma[:, :50].max() < 0.2


def test_a_fit_of_another_picture_is_its_line_alone(rng):
    uv, residual, shape = half_seen(rng, -0.4)
    fit = NearFit(np.log(0.5), 1.0, 0.03, len(uv), uv, np.zeros(len(uv)), residual).alone()
    metres = fit.applied(DepthMap(np.full(shape, 2.0, np.float32), np.full(shape, 0.1, np.float32)))
    np.testing.assert_allclose(metres.depth_m, 1.0, rtol=1e-4)
    assert metres.sigma_log.min() >= 0.29


def test_nearer_points_bring_depth_nearer(rng):
    uv, residual, shape = half_seen(rng, np.log(0.6))
    metres = NearFit(0.0, 1.0, 0.3, len(uv), uv, np.full(len(uv), LEVEL), residual).applied(
        DepthMap(np.full(shape, 2.0, np.float32), np.full(shape, 0.1, np.float32))
    )
    assert np.median(metres.depth_m[:, 10:60]) == pytest.approx(1.2, rel=0.08)


def test_occluded_points_do_not_increase_depth(rng):
    uv, residual, shape = half_seen(rng, 0.0)
    residual[::4] = 1.2
    error, _ = local_error(uv, np.zeros(len(uv)), residual, 0.1, np.zeros(shape))
    np.testing.assert_allclose(error, 0.0, atol=0.03)


def test_points_far_in_front_of_network_depth_count(rng):
    """A door leaf at 0.6 m before a wall that the network sees at 2 m, in a room that fits it to 10 %."""
    uv, residual, shape = half_seen(rng, np.log(0.3))
    metres = NearFit(0.0, 1.0, 0.1, len(uv), uv, np.full(len(uv), LEVEL), residual).applied(
        DepthMap(np.full(shape, 2.0, np.float32), np.full(shape, 0.1, np.float32))
    )
    assert np.median(metres.depth_m[:, 10:60]) == pytest.approx(0.6, rel=0.15)
