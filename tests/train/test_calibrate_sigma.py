"""Calibration of the predicted uncertainty."""

import pytest

from edgeslam_torch.train.calibrate_sigma import coverage


def test_coverage_of_a_normal_sigma_is_nominal(rng):
    sigma = rng.uniform(0.05, 0.4, 20000)
    one, two = coverage(rng.normal(0, sigma), sigma)
    assert one == pytest.approx(0.683, abs=0.02)
    assert two == pytest.approx(0.95, abs=0.01)
