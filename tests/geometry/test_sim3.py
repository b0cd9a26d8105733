"""Similarities: exponential and logarithm, groups' laws, least squares."""

import numpy as np
import pytest
from scipy.linalg import expm

from edgeslam_torch.geometry import se3, sim3


def generator(xi):
    """The matrix whose exponential a similarity is."""
    G = np.zeros((4, 4))
    G[:3, :3] = se3.hat(xi[3:6]) + xi[6] * np.eye(3)
    G[:3, 3] = xi[:3]
    return G


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e-4, 0.1, 1.0])
def test_exp_is_the_matrix_exponential_and_log_its_inverse(rng, size):
    for part in ([1] * 7, [1] * 6 + [0], [1, 1, 1, 0, 0, 0, 1], [1, 1, 1, 1e-7, 1e-7, 0, 1]):
        xi = size * rng.normal(size=7) * part
        np.testing.assert_allclose(sim3.exp(xi), expm(generator(xi)), atol=1e-9)
        np.testing.assert_allclose(sim3.log(sim3.exp(xi)), xi, atol=1e-8)


def test_inverse_and_parts(rng):
    S = sim3.exp(rng.normal(size=7))
    np.testing.assert_allclose(sim3.inverse(S) @ S, np.eye(4), atol=1e-12)
    scale, R, t = sim3.parts(S)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    p = rng.normal(size=(5, 3))
    np.testing.assert_allclose(sim3.transform(S, p), scale * p @ R.T + t, atol=1e-12)


def test_camera_of_a_moved_world_sees_the_same_pixels(rng):
    S, T_c_w = sim3.exp(rng.normal(size=7)), se3.exp(rng.normal(size=6))
    p = rng.normal(size=(20, 3)) + [0, 0, 5]
    before = se3.transform(T_c_w, p)
    after = se3.transform(sim3.moved_camera(S, T_c_w), sim3.transform(S, p))
    np.testing.assert_allclose(after, sim3.scale_of(S) * before, atol=1e-9)
