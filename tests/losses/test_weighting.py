"""Robust kernels and total loss."""

import pytest
import torch

from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.losses.total import TotalLoss


@pytest.mark.parametrize("kernel", list(Kernel))
def test_weight_is_the_derivative_of_the_cost(kernel):
    s = torch.tensor([0.0, 0.5, 3.9, 4.1, 30.0], dtype=torch.float64, requires_grad=True)
    cost, weight = rho(s, kernel, 2.0)
    (derivative,) = torch.autograd.grad(cost.sum(), s)
    torch.testing.assert_close(weight, derivative)
    assert cost[0].item() == pytest.approx(0.0, abs=1e-12)
    assert weight[0].item() == pytest.approx(1.0)


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
