"""Scale and shift of relative inverse depth."""

import numpy as np
import pytest

from edgeslam_torch.map.relative_depth import MIN_ANCHORS, fit_inverse

SCALE, SHIFT = 0.4, -0.05


@pytest.fixture
def scene(rng):
    """True depths of 200 anchors, and what a relative network says."""
    z = rng.uniform(1.0, 6.0, 200)
    return z, SCALE / (1.0 / z - SHIFT)


def test_line_is_found_despite_a_third_of_outliers(scene, rng):
    z, relative = scene
    wrong = z.copy()
    wrong[:66] *= rng.uniform(0.2, 0.6, 66)
    fit = fit_inverse(relative, wrong)
    assert (fit.scale, fit.shift) == (pytest.approx(SCALE, rel=1e-6), pytest.approx(SHIFT, rel=1e-6))
    np.testing.assert_allclose(fit.depth(relative), z, rtol=1e-6)
    np.testing.assert_allclose(relative * np.exp(fit.log_ratio_at(relative)), z, rtol=1e-6)


def test_sigma_covers_the_truth_and_grows_beyond_the_anchors(scene, rng):
    z, relative = scene
    inside, errors = [], []
    beyond = SCALE / (1.0 / 12.0 - SHIFT)
    for _ in range(100):
        some = rng.choice(len(z), 40, replace=False)
        fit = fit_inverse(relative[some], z[some] * np.exp(rng.normal(0.0, 0.1, 40)))
        errors.append(np.log(fit.depth(np.array([beyond])) / 12.0)[0] / fit.sigma(np.array([beyond]))[0])
        inside.append(fit.sigma_log)
        assert fit.sigma(np.array([beyond]))[0] > 1.1 * fit.sigma(np.array([np.median(relative)]))[0]
    assert np.mean(inside) == pytest.approx(0.1, rel=0.15)
    assert np.mean(np.abs(errors) < 2.0) >= 0.9


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0])
def test_too_few_anchors_are_no_fit(scene, bad):
    z, relative = scene
    few = np.where(np.arange(len(z)) < MIN_ANCHORS - 1, relative, bad)
    assert fit_inverse(few, z) is None
    assert fit_inverse(relative, np.where(np.arange(len(z)) < MIN_ANCHORS - 1, z, -1.0)) is None


def test_inverted_or_random_depth_and_a_single_depth_are_no_fit(scene, rng):
    z, relative = scene
    assert fit_inverse(1.0 / relative, z) is None
    assert fit_inverse(rng.uniform(0.5, 3.0, len(z)), z * np.exp(rng.normal(0.0, 1.5, len(z)))) is None
    assert fit_inverse(np.full(50, 2.0), np.full(50, 3.0)) is None
