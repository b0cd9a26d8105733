"""Training-only depth terms."""

import math

import pytest
import torch

from edgeslam_torch.losses.depth_terms import (
    BerHu,
    GradientMatching,
    LaplaceNll,
    LogSlope,
    MaskedL1,
    SILog,
    masked_mean,
)

TERMS = [MaskedL1(), BerHu(), SILog(), GradientMatching(scales=2), LogSlope()]


@pytest.fixture
def case():
    generator = torch.Generator().manual_seed(3)
    log_depth = torch.randn(2, 1, 6, 7, generator=generator, dtype=torch.float64)
    target = torch.randn(2, 1, 6, 7, generator=generator, dtype=torch.float64)
    mask = torch.rand(2, 1, 6, 7, generator=generator) > 0.3
    return log_depth, target, mask


@pytest.mark.parametrize("term", TERMS, ids=lambda t: type(t).__name__)
def test_zero_at_the_truth_and_untouched_by_masked_pixels(term, case):
    log_depth, target, mask = case
    torch.testing.assert_close(term(target, target, mask), torch.zeros(2, dtype=torch.float64))
    spoilt = torch.where(mask, target, torch.full_like(target, math.nan))
    torch.testing.assert_close(term(log_depth, spoilt, mask), term(log_depth, target, mask))


@pytest.mark.parametrize("term", TERMS, ids=lambda t: type(t).__name__)
def test_image_without_depth_costs_nothing_and_gives_a_finite_gradient(term):
    x = torch.randn(1, 1, 4, 4, requires_grad=True)
    value = term(x, torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4, dtype=torch.bool))
    value.sum().backward()
    assert value.item() == 0
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()


def test_values_by_hand():
    r = torch.tensor([0.0, 0.1, -0.2, 1.0]).view(1, 1, 2, 2)
    zero, mask = torch.zeros_like(r), torch.ones_like(r, dtype=torch.bool)
    assert MaskedL1()(r, zero, mask).item() == pytest.approx(1.3 / 4)
    # c = 0.2: |r| up to 0.2, then (1 + 0.04) / 0.4 = 2.6
    assert BerHu(0.2)(r, zero, mask).item() == pytest.approx((0.1 + 0.2 + 2.6) / 4)
    assert SILog(0.5)(r, zero, mask).item() == pytest.approx(1.05 / 4 - 0.5 * (0.9 / 4) ** 2)
    # one scale of one pixel: rows 0.1 and 1.2, columns 0.2 and 0.9; the scale of two pixels does not fit
    assert GradientMatching(1)(r, zero, mask).item() == pytest.approx(1.3 / 2 + 1.1 / 2)
    assert masked_mean(r, r > 0).item() == pytest.approx(0.55)


def test_uncertainty_is_best_at_the_mean_absolute_residual():
    """The optimum of |r| / b + log b is b = mean |r|; sigma = sqrt(2) b."""
    r = torch.tensor([0.1, -0.3, 0.2, 0.2]).view(1, 1, 2, 2)
    mask = torch.ones_like(r, dtype=torch.bool)
    best = math.log(math.sqrt(2) * 0.2)
    at = [LaplaceNll()(torch.full_like(r, best + d), r, torch.zeros_like(r), mask).item() for d in (-0.05, 0.0, 0.05)]
    assert at[1] == min(at)


def test_slope_detects_a_compressed_range_and_not_a_wrong_scale():
    near_and_far = torch.tensor([0.0, 0.0, 2.0, 2.0]).view(1, 1, 2, 2)  # variance 1
    mask = torch.ones_like(near_and_far, dtype=torch.bool)
    term = LogSlope(floor=0.25)
    for slope, cost in ((1.0, 0.0), (0.6, 0.4 / 1.25), (1.3, 0.3 / 1.25), (-1.0, 2.0 / 1.25)):
        assert term(slope * near_and_far - 3.0, near_and_far, mask).item() == pytest.approx(cost, abs=1e-6)
    squeezed = (0.5 * near_and_far).requires_grad_()
    term(squeezed, near_and_far, mask).sum().backward()
    assert squeezed.grad is not None
    assert torch.equal(squeezed.grad.sign(), torch.tensor([1.0, 1.0, -1.0, -1.0]).view(1, 1, 2, 2))  # nearer, farther
