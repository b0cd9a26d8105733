"""Motions in torch and numpy, and derivatives of priors against differences."""

import numpy as np
import pytest
import torch
from numeric import derivative
from torch import Tensor

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.optim.kernels.pose import logs
from edgeslam_torch.optim.priors import scale_prior
from edgeslam_torch.optim.problem import ScalePrior

POSES = {
    "general": [0.3, -0.1, 0.2, 0.05, -0.2, 0.1],
    "identity": [0.0] * 6,
    "tiny angle": [0.1, 0.0, 0.0, 1e-9, -1e-9, 1e-9],
    "large angle": [0.1, 0.2, 0.1, 0.1, 0.2, 2.8],
}


def tensor(x: object) -> Tensor:
    return torch.tensor(np.asarray(x), dtype=torch.float64)


@pytest.fixture(params=list(POSES))
def T(request: pytest.FixtureRequest) -> Tensor:
    return lie.exp(tensor(POSES[request.param]))


def test_torch_and_numpy_agree_on_exp_and_adjoint(T, rng):
    for xi in (*POSES.values(), 1e-5 * rng.normal(size=6)):
        np.testing.assert_allclose(lie.exp(tensor(xi)).numpy(), se3.exp(np.asarray(xi)), atol=1e-15)
    xi = tensor(1e-2 * rng.normal(size=6))
    torch.testing.assert_close(T @ lie.exp(xi), lie.exp(lie.adjoint(T) @ xi) @ T)
    torch.testing.assert_close(T @ lie.inverse(T), torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("xi", [[0.0] * 6, [1e-9] * 6, [0.1, 0.2, -0.3, 0.5, -0.4, 0.3]])
def test_exp_passes_gradcheck(xi):
    assert torch.autograd.gradcheck(lie.exp, tensor(xi).requires_grad_())


def test_relative_tangent_is_target_minus_adjoint_times_host(T, rng):
    T_i = lie.exp(tensor(0.3 * rng.normal(size=6)))
    xi_i, xi_j = tensor(1e-6 * rng.normal(size=(2, 6)))
    moved = (lie.exp(xi_j) @ T) @ lie.inverse(lie.exp(xi_i) @ T_i)
    T_j_i = T @ lie.inverse(T_i)
    predicted = lie.exp(xi_j - lie.adjoint(T_j_i) @ xi_i) @ T_j_i
    torch.testing.assert_close(moved, predicted, rtol=0, atol=1e-11)


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), np.ones(3)], ids=str)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_logs_invert_exp(rng, axis, angle):
    xi = np.concatenate((rng.normal(size=3), angle * axis / np.linalg.norm(axis)))
    np.testing.assert_allclose(logs(se3.exp(xi)[None])[0][0], xi, atol=1e-9)


def test_derivative_of_logs_by_differences(rng):
    xi = 0.4 * rng.normal(size=6)
    numeric = derivative(lambda d: se3.log(se3.exp(d) @ se3.exp(xi)), 6)
    np.testing.assert_allclose(logs(se3.exp(xi)[None])[1][0], numeric, atol=1e-6)  # the series ends at xi^7


def test_scale_prior_by_differences(rng):
    T_i, T_j = se3.exp(0.3 * rng.normal(size=6)), se3.exp(0.3 * rng.normal(size=6))
    prior = ScalePrior(0, 1, distance=0.4, sigma_log=0.1)
    _, J_i, J_j = scale_prior(T_i, T_j, prior)
    by_i = derivative(lambda d: scale_prior(se3.exp(d) @ T_i, T_j, prior)[0], 6)
    by_j = derivative(lambda d: scale_prior(T_i, se3.exp(d) @ T_j, prior)[0], 6)
    np.testing.assert_allclose((J_i, J_j), (by_i, by_j), atol=1e-6)
