"""Priors on poses against numeric derivatives."""

import numpy as np
import pytest
from numeric import derivative

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.kernels.pose import stepped
from edgeslam_torch.optim.priors import PriorTerms, relative_priors
from edgeslam_torch.optim.problem import RelativePosePrior


def pose(rng, size=0.5):
    return se3.exp(rng.normal(0.0, size, 6))


def relation(rng, T_i, T_j, off=0.3):
    """A prior that the two poses miss."""
    half = rng.normal(0.0, 1.0, (6, 6))
    return RelativePosePrior(0, 1, se3.exp(rng.normal(0.0, off, 6)) @ T_j @ se3.inverse(T_i), half @ half.T)


def relative_prior(T_i, T_j, prior):
    return [x[0] for x in relative_priors(T_i[None], T_j[None], prior.T_j_i[None])]


def test_adjoint_transforms_a_tangent(rng):
    T, d = pose(rng), rng.normal(0.0, 0.2, 6)
    np.testing.assert_allclose(se3.exp(se3.adjoint(T) @ d), T @ se3.exp(d) @ se3.inverse(T), atol=1e-12)


def test_relative_prior_is_met_by_the_relative_pose_alone(rng):
    T_i, T_j = pose(rng), pose(rng)
    prior = RelativePosePrior(0, 1, T_j @ se3.inverse(T_i), np.eye(6))
    world = pose(rng)  # another world: both cameras the same
    np.testing.assert_allclose(relative_prior(T_i @ world, T_j @ world, prior)[0], 0.0, atol=1e-12)


@pytest.mark.parametrize("which", [0, 1])
def test_relative_prior_derivatives(rng, which):
    T = [pose(rng), pose(rng)]
    prior = relation(rng, *T)
    numeric = derivative(
        lambda d: relative_prior(*[se3.exp(d) @ one if p == which else one for p, one in enumerate(T)], prior)[0], 6
    )
    np.testing.assert_allclose(relative_prior(*T, prior)[1 + which], numeric, atol=1e-6)


def test_the_normal_equations_are_those_of_the_cost(rng):
    """One pose fixed, one free: the gradient is half the cost's derivative, and a step leads to the prior."""
    T = np.stack([pose(rng), pose(rng)])
    terms = PriorTerms((relation(rng, *T, off=0.05),), (), np.array([-1, 0]))
    H, g = np.zeros((6, 6)), np.zeros(6)
    cost = terms.linearise(T, H, g)

    def at(T):
        return terms.linearise(T, np.zeros((6, 6)), np.zeros(6))

    slope = derivative(lambda d: at(np.stack([T[0], se3.exp(d) @ T[1]])), 6)
    np.testing.assert_allclose(2.0 * g, slope, rtol=1e-4, atol=1e-6)
    T[1] = se3.exp(-np.linalg.solve(H, g)) @ T[1]
    assert at(T) < 1e-2 * cost


def test_stepped_poses_are_those_of_the_exponential(rng):
    T, xi = np.stack([pose(rng) for _ in range(4)]), rng.normal(0.0, 1.0, (3, 6))
    xi[1] *= 1e-5  # the series
    out = stepped(T, np.array([2, 0, 3]), xi)
    for i, expected in ((0, se3.exp(xi[1]) @ T[0]), (1, T[1]), (2, se3.exp(xi[0]) @ T[2]), (3, se3.exp(xi[2]) @ T[3])):
        np.testing.assert_allclose(out[i], expected, atol=1e-12)
