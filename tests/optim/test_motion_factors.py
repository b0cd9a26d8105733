"""Camera-centre and gravity factors against finite differences and against what they mean."""

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.motion_factors import (
    MotionTerms,
    heading_residual,
)
from edgeslam_torch.optim.problem import CentreFactor, GravityFactor, HeadingFactor

STEP = 1e-6


def random_poses(rng, count):
    return np.stack([se3.exp(np.concatenate([rng.normal(size=3), rng.normal(0.0, 1.0, 3)])) for _ in range(count)])


def between(i, j, moved, sigma, count):
    """The Gaussian of ``c_j - c_i = moved``."""
    D = np.zeros((3, count, 3))
    D[:, j], D[:, i] = np.eye(3), -np.eye(3)
    D = D.reshape(3, -1) / sigma
    b = np.asarray(moved) / sigma
    return CentreFactor(np.arange(count), D.T @ D, D.T @ b, float(b @ b))


def cost(terms, T):
    free = int((terms.column >= 0).sum())
    return terms.linearise(T, np.zeros((6 * free, 6 * free)), np.zeros(6 * free))


def moved_by(T, pose, xi):
    out = T.copy()
    out[pose] = se3.exp(xi) @ T[pose]
    return out


@pytest.fixture
def terms(rng):
    """Five poses, the second fixed; two centre factors in another order than the poses', gravity and headings."""
    B = rng.normal(size=(9, 9))
    dense = CentreFactor(np.array([3, 1, 0]), B @ B.T, rng.normal(size=9), 2.0)
    pair = between(2, 4, [0.3, -0.2, 0.1], 0.05, 5)
    up_c = rng.normal(size=(3, 3))
    up_c /= np.linalg.norm(up_c, axis=1)[:, None]
    gravity = GravityFactor(np.array([4, 1, 2]), up_c, np.array([0.0, 0.6, 0.8]), 0.1)
    told = random_poses(rng, 4)[:, :3, :3]
    C = rng.normal(size=(4, 4))
    heading = HeadingFactor(np.array([2, 0, 1, 4]), told, np.array([0.48, 0.6, 0.64]), C @ C.T)
    return MotionTerms((dense, pair), (gravity,), (heading,), np.array([0, -1, 1, 2, 3]))


def test_gradient_and_curvature_are_those_of_the_cost(rng, terms):
    T = random_poses(rng, 5)
    H, g = np.zeros((24, 24)), np.zeros(24)
    assert terms.linearise(T, H, g) > 0.0
    numeric = np.zeros(24)
    for pose, column in ((0, 0), (2, 1), (3, 2), (4, 3)):
        for k in range(6):
            xi = STEP * np.eye(6)[k]
            up, down = (cost(terms, moved_by(T, pose, s * xi)) for s in (1, -1))
            numeric[6 * column + k] = (up - down) / (4 * STEP)  # half the derivative, as J^T r is
    np.testing.assert_allclose(g, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())
    np.testing.assert_allclose(H, H.T, atol=1e-9)


def test_curvature_of_centres_is_exact_in_the_translations(rng, terms):
    """The cost is quadratic in them, so the difference of two gradients is the curvature."""
    terms.gravity = terms.headings = ()
    T = random_poses(rng, 5)
    xi = np.concatenate([rng.normal(size=3), np.zeros(3)])
    H, g, moved_H, moved_g = (np.zeros(s) for s in ((24, 24), (24,)) * 2)
    terms.linearise(T, H, g)
    terms.linearise(moved_by(T, 3, xi), moved_H, moved_g)
    np.testing.assert_allclose(moved_g - g, H[:, 12:18] @ xi, rtol=1e-9, atol=1e-9)


def test_a_heading_is_a_rotation_about_the_vertical_only(rng):
    T = random_poses(rng, 2)
    up = np.array([0.0, 0.0, 1.0])
    for axis, turn, sine in ((up, 0.3, np.sin(0.3)), (up, -0.3, -np.sin(0.3)), (np.array([1.0, 0.0, 0.0]), 0.3, 0.0)):
        in_world = se3.exp(np.concatenate([np.zeros(3), turn * axis]))[:3, :3]
        factor = HeadingFactor(np.arange(2), T[:, :3, :3] @ in_world.T, up, np.eye(2))
        np.testing.assert_allclose(heading_residual(T, factor), sine, atol=1e-12)


def test_a_displacement_has_a_direction():
    """The camera that moved forward is ahead: the same displacement the other way round costs four times its square."""
    T_w_c = np.tile(np.eye(4), (2, 1, 1))
    T_w_c[1, :3, 3] = [0.5, 0.0, 0.0]
    T = se3.inverse(T_w_c)
    for moved, expected in (([0.5, 0.0, 0.0], 0.0), ([-0.5, 0.0, 0.0], 100.0), ([0.5, 0.1, 0.0], 1.0)):
        terms = MotionTerms((between(0, 1, moved, 0.1, 2),), (), (), np.arange(2))
        assert cost(terms, T) == pytest.approx(expected, abs=1e-9)


def test_gravity_has_a_direction():
    """A level camera sees up as minus y; upside down it is two radii off."""
    level = np.eye(4)
    level[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    T = se3.inverse(level)[None]
    for up_c, expected in (([0.0, -1.0, 0.0], 0.0), ([0.0, 1.0, 0.0], 400.0)):
        factor = GravityFactor(np.array([0]), np.array([up_c]), np.array([0.0, 0.0, 1.0]), 0.1)
        assert cost(MotionTerms((), (factor,), (), np.arange(1)), T) == pytest.approx(expected, abs=1e-9)
