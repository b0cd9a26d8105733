"""Constants against scipy's distributions, spreads and weights against samples."""

import numpy as np
import pytest

from edgeslam_torch.geometry import robust_statistics as rs


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_median_is_numpys_to_the_bit(rng, dtype):
    for n in [*range(1, 12), 301, 5000]:
        x = rng.normal(size=n).astype(dtype)
        assert rs.median(x) == np.median(x)
        assert rs.median(np.r_[x, np.full(n + 1, np.inf)]) == np.inf
        x[n // 2] = np.nan
        assert np.isnan(rs.median(x))
    assert np.isnan(rs.median(np.zeros(0)))


def test_robust_sigma_is_the_deviation_of_normal_errors_and_ignores_a_third_of_outliers(rng):
    x = rng.normal(0.0, 2.5, 20_000)
    assert rs.robust_sigma(x) == pytest.approx(2.5, rel=0.03)
    assert rs.robust_sigma(np.concatenate([x, np.full(6000, 1e6)])) < 2 * 2.5


def test_biweight_is_95_percent_efficient(rng):
    """Variance of the mean that it weighs, against the plain mean's, on normal errors."""
    x = rng.normal(size=(4000, 60))
    weight = rs.tukey_weight(x, 1.0)
    weighed = (weight * x).sum(1) / weight.sum(1)
    for _ in range(5):
        weight = rs.tukey_weight(x - weighed[:, None], 1.0)
        weighed = (weight * x).sum(1) / weight.sum(1)
    assert x.mean(1).var() / weighed.var() == pytest.approx(0.95, abs=0.02)
    assert rs.tukey_weight(np.array([-10.0, 10.0]), 2.0).tolist() == [0.0, 0.0]
