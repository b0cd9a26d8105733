"""Analytic derivatives against automatic ones, at ordinary poses, at identity and at tiny angles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses import edge_alignment as ea
from edgeslam_torch.losses.lshape import junction_residuals, junction_rows
from edgeslam_torch.losses.reprojection import camera_points, reprojection_residuals
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.optim.kernels.point_blocks import PointBlocks
from edgeslam_torch.optim.priors import inverse_left_jacobian, scale_prior
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, ScalePrior, WindowProblem

K = torch.tensor([500.0, 480.0, 320.0, 240.0], dtype=torch.float64)
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


def test_anchors_and_their_elimination(T, rng):
    """Normal equations, reduced system and back-substitution, against the dense Jacobian of plain residuals."""
    poses = torch.stack((T, lie.exp(tensor([0.1, 0, 0, 0, 0.1, 0])) @ T, lie.exp(tensor([0, 0.2, 0, 0.1, 0, 0])) @ T))
    p = (tensor(rng.uniform((-1, -1, 2), (1, 1, 5), (7, 3))) - T[:3, 3]) @ T[:3, :3]
    pose, anchor = (torch.as_tensor(x.ravel()) for x in np.meshgrid(np.arange(3), np.arange(7)))
    uv, inv_sigma = tensor(rng.uniform(0, 600, (21, 2))), tensor(rng.uniform(0.5, 2.0, 21))
    host, deep = torch.tensor([1, 2, 0, 0]), torch.tensor([0, 3, 3, 6])
    prior, sigma = tensor(rng.uniform(0.2, 0.5, 4)), tensor(rng.uniform(0.1, 0.3, 4))
    fixed = torch.tensor([False, True, False])
    problem = WindowProblem(
        poses.numpy(), fixed.numpy(), p.numpy(), pose.numpy(), anchor.numpy(), uv.numpy(), inv_sigma.numpy(), tuple(K)
    )
    depth = DepthPriors(deep.numpy(), host.numpy(), prior.numpy(), sigma.numpy())
    config = LmConfig(kernel=Kernel.L2, behind_px=1e6, float32_blocks=False)

    def residual(xi: Tensor, q: Tensor) -> Tensor:
        moved = poses.clone()
        moved[~fixed] = lie.exp(xi) @ moved[~fixed]
        r = reprojection_residuals(camera_points(moved, q, pose, anchor)[1], uv.mT, K) * inv_sigma
        iz = camera_points(moved, q, host, deep)[1][2].reciprocal()
        return torch.cat((r.flatten(), (iz - prior) / sigma))

    still = torch.zeros(2, 6, dtype=torch.float64)
    J = torch.cat([x.flatten(1) for x in torch.func.jacrev(residual, (0, 1))(still, p)], 1)
    r = residual(still, p)
    H, g = J.mT @ J, J.mT @ r
    points = PointBlocks(replace(problem, depth_priors=depth), K, np.array([0, -1, 1]), config)
    system, own, g_pose, cost = points.linearise(poses, points.p)
    torch.testing.assert_close(cost, r @ r)
    torch.testing.assert_close(own, H[:12, :12].view(2, 6, 2, 6)[[0, 1], :, [0, 1]], atol=1e-6, rtol=1e-9)
    torch.testing.assert_close(g_pose.flatten(), g[:12], atol=1e-6, rtol=1e-9)
    torch.testing.assert_close(system.g.mT.flatten(), g[12:], atol=1e-6, rtol=1e-9)
    S, b = H[:12, :12].clone(), g[:12].clone()
    eliminated = points.reduce(system, 0.0, S, b)
    taken = H[:12, 12:] @ torch.linalg.inv(H[12:, 12:])
    torch.testing.assert_close(S, H[:12, :12] - taken @ H[12:, :12], atol=1e-6, rtol=1e-8)
    torch.testing.assert_close(b, g[:12] - taken @ g[12:], atol=1e-6, rtol=1e-8)
    delta = tensor(rng.normal(size=12))
    expected = -torch.linalg.solve(H[12:, 12:], g[12:] + H[12:, :12] @ delta)
    torch.testing.assert_close(points.step(system, eliminated, delta).mT.flatten(), expected)


PAIRS = 6


def pairs(T: Tensor, rng: np.random.Generator, count: int = PAIRS) -> tuple[Tensor, Tensor]:
    """Rays and inverse depths of a host whose points lie in front of the target ``T`` too."""
    p_j = tensor(rng.uniform((-1, -1, 3), (1, 1, 6), (count, 3)))
    p_i = (p_j - T[:3, 3]) @ T[:3, :3]
    sign = torch.where(p_i[:, 2] > 0, 1.0, -1.0)  # a large turn may need them behind the host: algebra all the same
    return (p_i[:, :2] / p_i[:, 2:]).mT.contiguous(), sign / (p_i[:, 2].abs())


def spread(T: Tensor, count: int = PAIRS) -> Tensor:
    return T[:3, :, None].expand(3, 4, count)


@pytest.mark.parametrize("row", ["alignment", "relative depth", "round trip"])
@pytest.mark.parametrize("name", ["general", "identity", "tiny angle"])
def test_edge_pairs(row, name, rng):
    T = lie.exp(tensor(POSES[name]))
    ray, inverse_depth = pairs(T, rng)
    uv_j, normal = tensor(rng.uniform(0, 600, (2, PAIRS))), tensor(rng.normal(size=(2, PAIRS)))
    held = tensor(rng.uniform(0.2, 0.3, PAIRS))

    line = ea.partner_line(uv_j, normal, tensor(rng.uniform(0.5, 2, PAIRS)), K)
    weight = tensor(rng.uniform(0.5, 2, PAIRS))

    def rows(Rt: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        g = ea.pair_geometry(Rt, ray, d)
        slope = ea.depth_slopes(g, Rt[:, 3])
        if row == "alignment":
            J, Jd = ea.alignment_jacobians(g, slope, line)
            return ea.alignment_row(g, line), torch.stack(J), Jd
        if row == "relative depth":
            J, Jd = ea.relative_depth_jacobians(g, slope, held, weight)
            return ea.relative_depth_row(g, held) * weight, torch.stack(J), Jd
        torch.testing.assert_close(
            ea.round_trip_row(g, Rt, ray, held, K), ea.round_trip_jacobians(g, slope, Rt, ray, held, K)[0]
        )
        return ea.round_trip_jacobians(g, slope, Rt, ray, held, K)

    def residual(xi: Tensor, d: Tensor) -> Tensor:
        Rt = spread(lie.exp(xi) @ T)
        g = ea.pair_geometry(Rt, ray, d)
        if row == "alignment":
            return ea.alignment_row(g, line)
        if row == "relative depth":
            return ea.relative_depth_row(g, held) * weight
        p = torch.stack((g.x, g.y, torch.ones_like(g.x))) / held
        back = lie.inverse(lie.exp(xi) @ T)
        q = back[:3, :3] @ p + back[:3, 3:]
        return (q[:2] / q[2] - ray) * K[:2, None]

    zero = torch.zeros(6, dtype=torch.float64)
    by_pose, by_depth = torch.func.jacfwd(residual, (0, 1))(zero, inverse_depth)
    r, J, Jd = rows(spread(T), inverse_depth)
    torch.testing.assert_close(r, residual(zero, inverse_depth))
    torch.testing.assert_close(J, by_pose.movedim(-1, -2))
    torch.testing.assert_close(Jd, by_depth.diagonal(0, -2, -1))


@pytest.mark.parametrize("cosines", [False, True])
@pytest.mark.parametrize("name", ["general", "identity", "tiny angle"])
def test_junctions(cosines, name, rng):
    T = lie.exp(tensor(POSES[name]))
    ray, inverse_depth = pairs(T, rng, 3 * PAIRS)
    rays, x = ray.view(2, 3, PAIRS), inverse_depth.view(3, PAIRS)
    uv_j = tensor(rng.uniform(0, 600, (2, PAIRS)))
    angle = tensor(rng.uniform(0, 6, (2, PAIRS)))
    arms = torch.stack((angle.cos(), angle.sin()))

    def residual(xi: Tensor, d: Tensor) -> Tensor:
        return junction_rows(spread(lie.exp(xi) @ T), rays, d, uv_j, arms, K, cosines)[0]

    zero = torch.zeros(6, dtype=torch.float64)
    by_pose, by_depth = torch.autograd.functional.jacobian(residual, (zero, x))
    r, J, Jd, front = junction_rows(spread(T), rays, x, uv_j, arms, K, cosines)
    assert front.all()
    torch.testing.assert_close(r, junction_residuals(spread(T), rays, x, uv_j, arms, K, cosines)[0])
    torch.testing.assert_close(J, by_pose.movedim(-1, -2))
    torch.testing.assert_close(Jd, by_depth.diagonal(0, 1, 3))


def test_relative_tangent_is_target_minus_adjoint_times_host(T, rng):
    T_i = lie.exp(tensor(0.3 * rng.normal(size=6)))
    xi_i, xi_j = tensor(1e-6 * rng.normal(size=(2, 6)))
    moved = (lie.exp(xi_j) @ T) @ lie.inverse(lie.exp(xi_i) @ T_i)
    T_j_i = T @ lie.inverse(T_i)
    predicted = lie.exp(xi_j - lie.adjoint(T_j_i) @ xi_i) @ T_j_i
    torch.testing.assert_close(moved, predicted, rtol=0, atol=1e-11)


def test_inverse_left_jacobian_by_differences(rng):
    xi = 0.4 * rng.normal(size=6)
    step = 1e-6
    numeric = np.stack(
        [(se3.log(se3.exp(step * e) @ se3.exp(xi)) - se3.log(se3.exp(-step * e) @ se3.exp(xi))) for e in np.eye(6)], 1
    ) / (2 * step)
    np.testing.assert_allclose(inverse_left_jacobian(xi), numeric, atol=1e-6)  # the series ends at xi^7


def test_scale_prior_by_differences(rng):
    T_i, T_j = se3.exp(0.3 * rng.normal(size=6)), se3.exp(0.3 * rng.normal(size=6))
    prior = ScalePrior(0, 1, distance=0.4, sigma_log=0.1)
    _, J_i, J_j = scale_prior(T_i, T_j, prior)
    step = 1e-6
    for J, left, right in ((J_i, 1, 0), (J_j, 0, 1)):
        for k, e in enumerate(np.eye(6)):
            plus = scale_prior(se3.exp(left * step * e) @ T_i, se3.exp(right * step * e) @ T_j, prior)[0]
            minus = scale_prior(se3.exp(-left * step * e) @ T_i, se3.exp(-right * step * e) @ T_j, prior)[0]
            assert J[k] == pytest.approx((plus - minus) / (2 * step), abs=1e-6)
