"""Photometric reprojection."""

import sys

import kornia
import pytest
import torch

from edgeslam_torch.losses.photometric import ROUNDING_PX, PhotometricLoss, SmoothnessLoss, ssim, warp_to

K = torch.tensor([[[20.0, 0.0, 11.5], [0.0, 20.0, 7.5], [0.0, 0.0, 1.0]]], dtype=torch.float64)


def picture(shift_px=0.0):
    """Smooth stripes and blobs, moved to the right."""
    v, u = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    u = u - shift_px
    rgb = torch.stack((torch.sin(u * 0.7), torch.cos(u * 0.4 + v * 0.3), torch.sin(v * 0.5 - u * 0.2)))
    return (rgb[None].double() + 1) / 2


def sideways(x):
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, 0, 3] = x
    return T


def test_warp_is_kornias():
    torch.manual_seed(0)
    depth, T = 1.5 + torch.rand(2, 1, 16, 24).double(), sideways(0.2).repeat(2, 1, 1)
    T[1, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.1, 0.05], [0.1, 0.0, 0.02], [-0.05, -0.02, 0.0]]))
    images = torch.rand(2, 3, 16, 24).double()
    warped, valid = warp_to(images, depth, T, K.repeat(2, 1, 1))
    other = kornia.geometry.depth.warp_frame_depth(images, depth, T, K.repeat(2, 1, 1))
    assert valid.float().mean() > 0.7
    apart = (warped - other).abs()[valid.expand_as(warped)]
    assert apart.quantile(0.99) < 1e-5
    assert apart.max() < ROUNDING_PX  # on the border, where kornia's begins to be black


def test_structural_similarity_is_kornias_with_a_mean_for_its_gaussian(monkeypatch):
    torch.manual_seed(0)
    a, b = torch.rand(2, 2, 3, 16, 24).double()
    mean = torch.full((1, 3), 1 / 3).double()
    monkeypatch.setattr(sys.modules["kornia.metrics.ssim"], "get_gaussian_kernel1d", lambda *_, **__: mean)
    torch.testing.assert_close(ssim(a, b), kornia.metrics.ssim(a, b, 3), atol=1e-5, rtol=0)


def test_loss_prefers_the_true_depth():
    loss = PhotometricLoss()
    image_i, images_j = picture(), picture(2.0)[:, None]
    costs = [
        loss(image_i, images_j, torch.full((1, 1, 16, 24), z).double(), sideways(0.2)[:, None], K).item()
        for z in (1.4, 2.0, 3.2)
    ]
    # Not zero: SSIM looks one pixel into the strip that frame j does not see.
    assert costs[1] < 0.01
    assert costs[1] < min(costs[0], costs[2]) / 5


def test_smoothness_ignores_slopes_and_bends_at_contrast():
    flat = torch.full((1, 3, 8, 8), 0.5)
    slope = torch.linspace(0, 1, 8).expand(1, 1, 8, 8)
    assert SmoothnessLoss()(slope, flat).item() == pytest.approx(0, abs=1e-6)
    step = (torch.arange(8) > 3).float().expand(1, 1, 8, 8)
    edge = (torch.arange(8) > 3).float().expand(1, 3, 8, 8)
    assert SmoothnessLoss()(step, edge).item() < 0.01 * SmoothnessLoss()(step, flat).item()


def test_a_depth_that_is_lost_under_a_hole_leaves_no_gradient():
    image = torch.full((1, 3, 8, 8), 0.5).requires_grad_()
    log_depth = torch.zeros(1, 1, 8, 8)
    hole = torch.zeros(8, 8, dtype=torch.bool)
    hole[3, 3] = True
    log_depth = log_depth.masked_fill(hole, torch.nan).requires_grad_()
    seen = image.masked_fill(hole, torch.nan)
    loss = SmoothnessLoss()(log_depth, seen)
    loss.backward()
    assert loss.item() == 0
    assert log_depth.grad.isfinite().all() and image.grad.isfinite().all()
