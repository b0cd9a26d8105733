"""Properties of every loss: zero at the truth, forward from residuals, correct gradients, finite degenerate cases."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses.base import ResidualLoss, back_project, move, project
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss
from edgeslam_torch.losses.edge_alignment import EdgeAlignmentLoss
from edgeslam_torch.losses.lshape import AngleForm, AngleLoss, CollinearityLoss, cosine
from edgeslam_torch.losses.reprojection import ReprojectionLoss
from edgeslam_torch.losses.robust import Kernel, rho

K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@dataclass(frozen=True)
class Case:
    """A loss as a function of the tangent and depth scale of a noise-free two-view world; the truth is zero, one."""

    loss: ResidualLoss
    arguments: Callable[[Tensor, Tensor], tuple[Tensor, ...]]


def world(rng):
    def tensor(x):
        return torch.tensor(x, dtype=torch.float64)

    T_j_i = lie.exp(tensor(np.array([0.3, -0.1, 0.15, 0.02, -0.05, 0.08])))
    uv = tensor(rng.uniform((80, 60), (560, 420), (24, 2)))
    depth = tensor(rng.uniform(2, 5, 24))
    p_j = move(T_j_i, back_project(uv, depth, K))
    uv_j, _ = project(p_j, K)
    normal = tensor(rng.normal(size=(24, 2)))
    return {
        "T_j_i": T_j_i,
        "uv": uv,
        "depth": depth,
        "p_i": back_project(uv, depth, K),
        "uv_j": uv_j,
        "depth_j": p_j[:, 2],
        "normal": normal / normal.norm(dim=1, keepdim=True),
    }


def cases(rng):
    w = world(rng)
    eye = torch.eye(4, dtype=torch.float64)
    corners, corner_depths = w["uv"].view(8, 3, 2), w["depth"].view(8, 3)
    arms_j = w["uv_j"].view(8, 3, 2)
    cos_j, _ = cosine(arms_j[:, 1] - arms_j[:, 0], arms_j[:, 2] - arms_j[:, 0])
    steps = torch.linspace(0, 1, 5, dtype=torch.float64)[:, None]
    starts, ends = w["p_i"][:8].view(4, 2, 1, 3), w["p_i"][8:16].view(4, 2, 1, 3)
    lines = starts + steps * (ends - starts)
    bend = torch.tensor(rng.normal(size=lines.shape), dtype=torch.float64)

    def moved(xi):
        return lie.exp(xi) @ w["T_j_i"]

    def views(xi, s):
        return torch.stack((eye, moved(xi))), s * w["p_i"], torch.stack((w["uv"], w["uv_j"])), K

    def cycle(xi, s):
        return moved(xi), w["uv"], s * w["depth"], w["depth_j"], K

    def align(xi, s):
        return moved(xi), w["uv"], s * w["depth"], w["uv_j"], w["normal"], K

    def angle(xi, s):
        return moved(xi), corners, s * corner_depths, cos_j, K

    def arms(xi, s):
        return (lines + (s - 1.0) * bend + 0.0 * xi.sum(),)

    out = {
        "reprojection": Case(ReprojectionLoss(), views),
        "reprojection, literal": Case(ReprojectionLoss(reduction="sum"), views),
        "edge alignment": Case(EdgeAlignmentLoss(), align),
        "angle": Case(AngleLoss(), angle),
        "collinearity": Case(CollinearityLoss(), arms),
        "collinearity, literal": Case(CollinearityLoss(literal=True, reduction="sum"), arms),
        "cycle, literal": Case(CycleLoss.literal(), cycle),
    }
    return out | {f"cycle, {form}": Case(CycleLoss(form), cycle) for form in CycleForm}


NAMES = list(cases(np.random.default_rng(0)))
OFF = (torch.tensor([0.01, -0.02, 0.01, 0.004, 0.002, -0.003], dtype=torch.float64), 1.03)


@pytest.fixture
def case(request, rng):
    return cases(rng)[request.param]


@pytest.mark.parametrize("case", NAMES, indirect=True)
def test_zero_for_the_truth_and_not_beside_it(case):
    zero, one = torch.zeros(6, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    assert float(case.loss(*case.arguments(zero, one))) < 1e-18
    assert float(case.loss(*case.arguments(*OFF))) > 1e-8


@pytest.mark.parametrize("case", NAMES, indirect=True)
def test_forward_reduces_squared_residuals(case):
    residuals = case.loss.residuals(*case.arguments(*OFF))
    total = residuals.value.square().sum()
    assert residuals.valid.any()
    if case.loss.reduction == "mean":
        corners = isinstance(case.loss, CollinearityLoss)
        total = total / (len(residuals.valid) if corners else residuals.valid.sum())
    torch.testing.assert_close(case.loss(*case.arguments(*OFF)), total)


@pytest.mark.parametrize("kernel", list(Kernel))
@pytest.mark.parametrize("case", NAMES, indirect=True)
def test_gradient_under_a_kernel_is_twice_weighted_jacobian_times_residual(case, kernel):
    loss = case.loss
    loss.kernel, loss.delta = kernel, 0.5 * float(loss.residuals(*case.arguments(*OFF)).value.abs().max())

    def residual(xi):
        value = loss.residuals(*case.arguments(xi, OFF[1])).value
        return value.reshape(-1, value.shape[-1])  # (N, R)

    xi = OFF[0].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(*case.arguments(xi, OFF[1])), xi)
    r, J = residual(OFF[0]), torch.func.jacrev(residual)(OFF[0])
    cost, weight = rho(r.square().sum(-1), kernel, loss.delta)
    expected = 2.0 * torch.einsum("n,nr,nrk->k", weight, r, J) * loss(*case.arguments(*OFF)) / cost.sum()
    torch.testing.assert_close(gradient, expected.detach(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("case", NAMES, indirect=True)
def test_empty_and_behind_give_finite_zero(case):
    zero, one = torch.zeros(6, dtype=torch.float64), torch.ones((), dtype=torch.float64)
    xi = zero.clone().requires_grad_()
    behind = case.loss(*case.arguments(xi, -one))  # every depth negative: all behind
    (gradient,) = torch.autograd.grad(behind, xi, allow_unused=True)
    if isinstance(case.loss, CollinearityLoss):  # it has no camera: nothing is behind
        assert behind.isfinite()
    else:
        assert behind == 0.0
        assert gradient is not None
        assert (gradient == 0.0).all()
        residuals = case.loss.residuals(*case.arguments(zero, -one))
        seen = residuals.valid if residuals.valid.ndim == 1 else residuals.valid[0]
        assert not seen.any()


@pytest.mark.parametrize("form", [AngleForm.SAME_FRAME, AngleForm.CROSS_VIEW])
def test_same_frame_angle_is_zero_whatever_the_depth_and_cross_view_is_not(form, rng):
    w = world(rng)
    corners = w["uv"].view(8, 3, 2)
    wrong = torch.tensor(rng.uniform(1, 6, (8, 3)))
    arms_j = w["uv_j"].view(8, 3, 2)
    cos_j, _ = cosine(arms_j[:, 1] - arms_j[:, 0], arms_j[:, 2] - arms_j[:, 0])
    value = float(AngleLoss(form)(w["T_j_i"], corners, wrong, cos_j, K))
    assert value < 1e-24 if form is AngleForm.SAME_FRAME else value > 1e-3


def test_right_angle_prior_pulls_only_nearly_square_corners():
    def corner(degrees):
        a = np.radians(degrees)
        p = torch.tensor([[[0.0, 0, 2], [0.5, 0, 2], [0.5 * np.cos(a), 0.5 * np.sin(a), 2]]], dtype=torch.float64)
        return project(p, K)[0], p[..., 2]

    loss = AngleLoss(AngleForm.RIGHT_ANGLE)
    eye, none = torch.eye(4, dtype=torch.float64), torch.full((1,), torch.nan, dtype=torch.float64)
    for degrees, expected in ((90, 0.0), (80, np.cos(np.radians(80)) ** 2), (60, 0.0)):
        assert float(loss(eye, *corner(degrees), none, K)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("literal", [False, True])
def test_gradient_of_collinearity_does_not_shrink_the_scene_unless_literal(literal, rng):
    """What does not change with the scale must not have a gradient along it."""
    p = torch.tensor(rng.normal(size=(3, 2, 6, 3)) + [0, 0, 5], dtype=torch.float64, requires_grad=True)
    value = CollinearityLoss(literal)(p)
    (gradient,) = torch.autograd.grad(value, p)
    assert float((gradient * p).sum().detach() / value.detach()) == pytest.approx(2.0 if literal else 0.0, abs=1e-9)


def test_collinearity_of_a_known_bend():
    # Three points of an arm of length 2, the middle one h off: offsets from the best line are h/3, 2h/3, h/3.
    h = 0.3
    arm = torch.tensor([[-1.0, 0, 3], [0, h, 3], [1, 0, 3]], dtype=torch.float64)
    straight = torch.tensor([[-1.0, 0, 3], [0, 0, 3], [1, 0, 3]], dtype=torch.float64)
    value = float(CollinearityLoss(literal=True)(torch.stack((arm, straight))[None]))
    assert value == pytest.approx((h / 3) ** 2 * 6 / 3)


def test_collinearity_ignores_masked_points_and_short_arms(rng):
    line = torch.linspace(0, 1, 5, dtype=torch.float64)[:, None] * torch.tensor([1.0, 1, 1], dtype=torch.float64)
    p = torch.stack((line, line))[None].clone()
    p[0, 0, 4] += 9.0 * torch.tensor([1.0, 0, 0])
    mask = torch.ones(1, 2, 5, dtype=torch.bool)
    mask[0, 0, 4] = False
    assert float(CollinearityLoss()(p, mask)) < 1e-18
    mask[0, 0, 2:] = False  # two points are always on a line
    assert not CollinearityLoss().residuals(p, mask).valid[0, 0].any()


def test_residuals_are_predicted_minus_observed():
    """A point seen at (417, 194) and at (427, 186) that projects to (420, 190): 3 and -7 px in u, -4 and 4 in v."""
    T, p = torch.eye(4, dtype=torch.float64), torch.tensor([[0.4, -0.2, 2.0]], dtype=torch.float64)
    K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    seen = torch.tensor([[417.0, 194.0], [427.0, 186.0]], dtype=torch.float64)
    right = torch.tensor([[3.0, -4.0], [-7.0, 4.0]], dtype=torch.float64)
    window = ReprojectionLoss().residuals(torch.stack((T, T)), p, seen[:, None], K)
    torch.testing.assert_close(window.value[:, 0], right)
    across = torch.tensor([[0.6, 0.8]], dtype=torch.float64)
    edge = EdgeAlignmentLoss().residuals(T, torch.tensor([[420.0, 190.0]]), p[:, 2], seen[1:], across, K)
    torch.testing.assert_close(edge.value, right[1:] @ across.mT)  # -7 * 0.6 + 4 * 0.8
    behind = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    nearer = CycleLoss(max_relative=1.0).residuals(
        T, torch.tensor([[320.0, 240.0]]), behind[:, 2] * 3.0, behind[:, 2], K
    )
    assert float(nearer.value) == pytest.approx(0.5)  # frame j sees 1 m where 3 m are predicted
