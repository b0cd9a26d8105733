"""Depth priors of pixels from the network and the anchors."""

import numpy as np
import pytest
from point_map import filled

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.depth_prior import depth_prior, fit_to_anchors, sample
from edgeslam_torch.types import DepthMap


def test_fit_returns_the_scatter_of_anchors(rng):
    network = rng.uniform(0.5, 5.0, 4000)
    fit = fit_to_anchors(network, network * np.exp(rng.normal(0.3, 0.2, 4000)))
    assert fit.log_ratio == pytest.approx(0.3, abs=0.02)
    assert fit.sigma_log == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0])
def test_too_few_usable_anchors_give_no_fit(bad):
    network = np.r_[np.ones(7), np.full(20, bad)]
    assert fit_to_anchors(network, np.ones(27)) is None
    assert fit_to_anchors(np.ones(27), np.r_[np.ones(7), np.full(20, -1.0)]) is None


@pytest.fixture
def points(rng):
    return filled(rng, 300, 3)


def at_keypoints(keyframe, z, sigma_log, **kind):
    """A depth map that knows the keypoints of a keyframe."""
    depth = np.full((480, 640), np.nan, np.float32)
    u, v = np.rint(keyframe.features.uv).astype(int).T
    depth[np.clip(v, 0, 479), np.clip(u, 0, 639)] = z
    return DepthMap(depth, np.full((480, 640), sigma_log, np.float32), **kind)


def test_neighbouring_anchors_replace_a_missing_network(points):
    keyframe, z = points.keyframes[0], points.depths(0)
    prior, sigma = depth_prior(keyframe, keyframe.features.uv, points.map.anchors)
    assert (sigma == 0.35).all()
    assert prior.min() >= z.min() * 0.999
    assert prior.max() <= z.max() * 1.001
    # Smooth walls: what the prior claims as its sigma holds for two thirds.
    assert np.mean(np.abs(np.log(prior / z)) < 0.35) > 0.68


@pytest.mark.parametrize(("twist", "stated", "sigma_log"), [(0.0, 0.01, 0.051), (0.0, 0.12, 0.13), (0.3, 0.01, 0.061)])
def test_a_wrong_network_is_corrected_by_anchors_with_a_larger_sigma(points, twist, stated, sigma_log):
    """Its metre is three map units, and an error grows across the image, as in an unfamiliar room."""
    keyframe, z = points.keyframes[0], points.depths(0)
    error = twist * (np.rint(keyframe.features.uv[:, 0]) - 320) / 320
    keyframe.depth = at_keypoints(keyframe, z / 3.0 * np.exp(error), stated)
    prior, prior_sigma = depth_prior(keyframe, keyframe.features.uv, points.map.anchors)
    known = np.isfinite(prior)
    left = np.abs(np.log(prior / z))[known]
    assert np.median(left) <= 0.5 * np.median(np.abs(error)) + 0.01
    assert np.median(prior_sigma[known]) == pytest.approx(sigma_log, rel=0.15)
    assert np.mean(left < 2.5 * prior_sigma[known]) > 0.9


def test_relative_depth_is_fitted_by_scale_and_shift_to_triangulated_anchors(points):
    keyframe, z = points.keyframes[0], points.depths(0)
    keyframe.depth = at_keypoints(keyframe, 0.7 / (1.0 / z - 0.02), 0.25, is_relative=True)
    prior, sigma = depth_prior(keyframe, keyframe.features.uv, points.map.anchors)
    known = np.isfinite(prior)
    assert known.mean() > 0.9
    np.testing.assert_allclose(prior[known], z[known], rtol=0.02)
    assert np.median(sigma) < 0.1
    points.map.anchors.from_depth[:] = True
    np.testing.assert_allclose(depth_prior(keyframe, keyframe.features.uv, points.map.anchors)[1], 0.35)


def test_sampling_takes_the_nearest_pixel_and_preserves_holes():
    depth = np.array([[1.0, 2.0, 0.0], [4.0, np.nan, 6.0]], np.float32)
    sigma = np.full((2, 3), 0.25, np.float32)
    uv = np.array([[0.4, 0.4], [0.6, 0.0], [2.0, 0.0], [1.0, 1.0], [9.0, 9.0], [-3.0, 1.0]])
    z, s = sample(DepthMap(depth, sigma), uv)
    np.testing.assert_array_equal(z, [1.0, 2.0, np.nan, np.nan, 6.0, 4.0])
    np.testing.assert_allclose(s, 0.25)


def test_fit_finds_the_ratio_despite_a_third_of_outliers(rng):
    network = rng.uniform(0.5, 5.0, 60)
    anchors = 2.5 * network
    anchors[:20] *= rng.uniform(0.2, 0.6, 20)
    fit = fit_to_anchors(network, anchors)
    assert fit.anchors == 60
    assert fit.log_ratio == pytest.approx(np.log(2.5))
    assert fit.sigma_log == 0.02  # its floor: most agree exactly


@pytest.mark.parametrize("behind", [False, True])
def test_keyframe_without_anchors_before_it_has_a_wide_prior(points, behind):
    keyframe = points.keyframes[0]
    if behind:
        keyframe.T_c_w = se3.exp(np.array([0, 0, 0, 0, np.pi, 0])) @ keyframe.T_c_w
    else:
        keyframe.anchor[:] = -1
    prior, sigma = depth_prior(keyframe, keyframe.features.uv[:4], points.map.anchors)
    assert np.isnan(prior).all()
    assert np.isinf(sigma).all()
