"""Robust kernels, total loss and adaptive weights."""

import pytest
import torch

from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.losses.total import TotalLoss
from edgeslam_torch.losses.weighting import AdaptiveScales, TermScale, robust_sigma


@pytest.mark.parametrize("kernel", list(Kernel))
def test_weight_is_the_derivative_of_the_cost(kernel):
    s = torch.tensor([0.0, 0.5, 3.9, 4.1, 30.0], dtype=torch.float64, requires_grad=True)
    cost, weight = rho(s, kernel, 2.0)
    (derivative,) = torch.autograd.grad(cost.sum(), s)
    torch.testing.assert_close(weight, derivative)
    assert cost[0].item() == pytest.approx(0.0, abs=1e-12)
    assert weight[0].item() == pytest.approx(1.0)


def test_kernels_order_by_their_weight_of_outliers():
    s = torch.tensor([100.0], dtype=torch.float64)
    weights = [float(rho(s, k, 2.0)[1]) for k in (Kernel.L2, Kernel.HUBER, Kernel.CAUCHY, Kernel.TUKEY)]
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] == 0.0


def test_robust_sigma_finds_the_inliers_spread():
    generator = torch.Generator().manual_seed(0)
    r = 0.7 * torch.randn(4000, generator=generator)
    r[:800] *= 100.0  # a fifth are outliers: the median of |r| rises to the 0.625 quantile, 1.32 sigma
    assert 0.7 < float(robust_sigma(r)) < 0.7 * 1.4


def test_scale_is_smooth_clamped_and_unmoved_by_few():
    scale = TermScale(1.0, 0.5, 2.0)
    few, wild = torch.full((10,), 9.0), torch.full((100,), 50.0)
    assert scale.updated(few) == scale
    once = scale.updated(wild)
    assert 1.0 < once.sigma < 2.0
    for _ in range(50):
        once = once.updated(wild)
    assert once.sigma == pytest.approx(2.0, rel=1e-4)
    assert AdaptiveScales().updated({"edge": wild}).terms["reproj"] == AdaptiveScales().terms["reproj"]


@pytest.mark.parametrize("low, sigma, high", [(0.0, 1.0, 2.0), (1.0, 0.5, 2.0), (1.0, 3.0, 2.0)])
def test_scale_refuses_a_wrong_range(low, sigma, high):
    with pytest.raises(ValueError, match="low <= sigma"):
        TermScale(sigma, low, high)


def test_total_is_the_weighted_sum_and_refuses_what_it_does_not_know():
    total = TotalLoss({"reproj": 2.0, "cycle": 0.5})
    terms = {"reproj": torch.tensor(1.5), "cycle": torch.tensor(4.0)}
    assert float(total(terms)) == pytest.approx(5.0)
    with pytest.raises(ValueError, match="shape"):
        total({"shape": torch.tensor(1.0)})
    with pytest.raises(ValueError, match="must be some of"):
        total({})
    with pytest.raises(ValueError, match="negative"):
        TotalLoss({"cycle": -1.0})


def test_total_of_a_batch_has_one_value_an_item_and_terms_have_one_shape():
    total = TotalLoss({"reproj": 2.0, "cycle": 0.5, "shape": 0.0})
    reproj, cycle = torch.tensor([1.0, 2.0]), torch.tensor([4.0, 0.0])
    assert total({"reproj": reproj, "cycle": cycle, "shape": reproj}).tolist() == [4.0, 4.0]
    assert total({"shape": reproj}).tolist() == [0.0, 0.0]
    assert set(total.weighted({"reproj": reproj, "shape": reproj})) == {"reproj"}
    with pytest.raises(ValueError, match=r"one shape, got .'reproj': \(2,\), 'cycle': \(\)"):
        total({"reproj": reproj, "cycle": cycle.sum()})
