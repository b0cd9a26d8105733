"""The compiled residuals and derivatives against the loss modules and their automatic differentiation."""

from itertools import product

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim import modules
from edgeslam_torch.optim.kernels import rows
from edgeslam_torch.optim.kernels.edges import NONE, PIXEL, RELATIVE_DEPTH

K = (500.0, 480.0, 320.0, 240.0)
MOTIONS = {
    "general": [0.3, -0.1, 0.2, 0.05, -0.2, 0.1],
    "identity": [0.0] * 6,
    "no parallax": [0.0, 0.0, 0.0, 0.1, -0.2, 0.05],
    "tiny angle": [0.1, 0.0, 0.0, 1e-9, -1e-9, 1e-9],
    "large angle": [0.1, 0.2, 0.1, 0.1, 0.2, 1.5],
    "behind the camera": [0.0, 0.0, 0.0, 0.0, 3.1, 0.0],
    "partly behind": [0.0, 0.0, -4.0, 0.0, 0.3, 0.0],
}
N = 12


def agree(kind, *arguments):
    """Both forms' rows; returns how many lie in front."""
    r, J, front = getattr(rows, kind)(*arguments)
    r_by_modules, J_by_modules, front_by_modules = getattr(modules, kind)(*arguments)
    np.testing.assert_array_equal(front, front_by_modules)
    np.testing.assert_allclose(r, r_by_modules, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(J, J_by_modules, rtol=1e-8, atol=1e-8 * max(1.0, np.abs(J).max()))
    return front.sum()


def unit(rng, *shape):
    angle = rng.uniform(0, 2 * np.pi, shape)
    return np.stack([np.cos(angle), np.sin(angle)], -1)


@pytest.fixture(params=MOTIONS)
def T(request, rng):
    """Three poses about a named motion."""
    motion = se3.exp(np.array(MOTIONS[request.param]))
    return np.stack([motion, se3.exp(np.array([0.1, 0, 0, 0, 0.1, 0])) @ motion, motion])


@pytest.fixture
def seen(rng):
    """Which of three poses sees which of five points, blocks not in order."""
    return rng.integers(0, 3, N), rng.integers(0, 5, N)


@pytest.mark.parametrize("kind", ["reprojection", "inverse_depth"])
def test_anchors(kind, T, seen, rng):
    p = rng.uniform((-1, -1, 2), (1, 1, 5), (5, 3))
    weight = rng.uniform(0.5, 2.0, N)
    if kind == "reprojection":
        agree(kind, T, p, *seen, rng.uniform(0, 600, (N, 2)), weight, K)
    else:
        agree(kind, T, p, *seen, rng.uniform(0.2, 0.5, N), weight)


@pytest.mark.parametrize("cycle", [NONE, RELATIVE_DEPTH, PIXEL])
def test_edges(cycle, T, seen, rng):
    held = np.where(rng.random(N) < 0.7, rng.uniform(0.2, 0.5, N), 0.0)
    partner = rng.uniform(0, 600, (N, 2)), unit(rng, N), rng.uniform(0.5, 2.0, N), held
    agree("edges", T, *seen, rng.uniform(0, 600, (5, 2)), rng.uniform(0.2, 0.5, 5), *partner, cycle, 3.0, K)


@pytest.mark.parametrize("cosines", [False, True])
def test_junctions(cosines, T, seen, rng):
    corner = rng.uniform(100, 400, (5, 1, 2))
    uv = np.concatenate((corner, corner + 30.0 * unit(rng, 5, 2)), 1)
    target = rng.uniform(0, 600, (N, 2)), unit(rng, N, 2)
    agree("junctions", T, *seen, uv, rng.uniform(0.2, 0.5, (5, 3)), *target, 1.5, 20.0, cosines, K)


def test_points_behind_the_camera_have_no_residual(rng):
    p = np.array([[0.0, 0.0, -1.0], [0.3, 0.1, 2.0], [1.0, 1.0, 0.0]])
    nothing = np.zeros(3, int), np.arange(3)
    assert agree("reprojection", np.eye(4)[None], p, *nothing, np.zeros((3, 2)), np.ones(3), K) == 1
    assert agree("inverse_depth", np.eye(4)[None], p, *nothing, np.ones(3), np.ones(3)) == 1


def test_a_point_at_infinity_is_no_special_case(rng):
    T = se3.exp(np.array([0.2, 0.1, 0.0, 0.0, 0.1, 0.0]))[None]
    zero = np.zeros(1, int)
    args = np.array([[300.0, 200.0]]), np.array([1e-4]), np.array([[310.0, 190.0]]), unit(rng, 1), np.ones(1)
    for held, cycle in product((0.0, 0.3), (RELATIVE_DEPTH, PIXEL)):
        assert agree("edges", T, zero, zero, *args, np.array([held]), cycle, 1.0, K) == 1
