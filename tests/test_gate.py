"""The chi-square gate."""

import math

import numpy as np
import pytest
from scipy.special import chdtrc

from edgeslam_torch.gate import exceedance, passes


@pytest.mark.parametrize("components", [1, 2, 3, 6, 7, 15])
def test_exceedance_is_the_tail_of_chi_square(components):
    for distance in (0.0, 1e-3, 1.0, 7.0, 60.0):
        assert exceedance(distance, components) == pytest.approx(chdtrc(components, distance), rel=1e-12)


def test_the_gate_at_extreme_distances():
    assert passes(np.zeros(3), np.eye(3))
    assert not passes(np.full(3, 1e200), np.eye(3))
    assert not passes(np.full(3, math.nan), np.eye(3))
    assert passes(np.array([5.0]), np.array([[math.inf]]))
