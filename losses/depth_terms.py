"""Training-only depth terms: each takes log depth ``(B, 1, H, W)`` and a mask, and returns one value per image.

Per-image means (not means over the batch's pixels) make the loss of a batch the mean of its images'
losses, so the
same batch split over two processes gives the same gradient.
"""

import torch
from torch import Tensor, nn


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``x`` where ``mask``, per image: ``(B, ...) -> (B,)``; 0 for an image without a valid pixel."""
    weight = mask.to(x.dtype)
    total = torch.where(mask, x, torch.zeros_like(x)).flatten(1).sum(1)
    return total / weight.flatten(1).sum(1).clamp(min=1.0)


class MaskedL1(nn.Module):
    """Mean absolute difference of log depth: a relative error, weighted equally near and far."""

    def residuals(self, log_depth: Tensor, log_target: Tensor) -> Tensor:
        """Predicted minus observed log depth, ``(B, 1, H, W)``."""
        return log_depth - log_target

    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``(B,)``."""
        return masked_mean(self.residuals(log_depth, log_target).abs(), mask)


class BerHu(nn.Module):
    """Reverse Huber (Laina et al., 3DV 2016): linear below ``c``, quadratic above.

    Args:
        fraction: ``c`` is this fraction of the image's largest residual (0.2 in the paper).
    """

    def __init__(self, fraction: float = 0.2) -> None:
        super().__init__()
        self.fraction = fraction

    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``(B,)``."""
        r = torch.where(mask, log_depth - log_target, 0.0).abs()
        c = (self.fraction * r.flatten(1).amax(1)).clamp(min=1e-6).view(-1, *[1] * (r.ndim - 1))
        return masked_mean(torch.where(r <= c, r, (r * r + c * c) / (2 * c)), mask)


class SILog(nn.Module):
    """Scale-invariant log error (Eigen et al., 2014): ``mean(r^2) - balance * mean(r)^2``.

    Args:
        balance: 1 ignores the scale entirely, 0 is the plain mean square; the paper trains with 0.5.
    """

    def __init__(self, balance: float = 0.5) -> None:
        super().__init__()
        self.balance = balance

    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``(B,)``."""
        r = log_depth - log_target
        return masked_mean(r * r, mask) - self.balance * masked_mean(r, mask).square()


class GradientMatching(nn.Module):
    """Absolute difference of the residual's gradients over several scales (MegaDepth, CVPR 2018): keeps
    edges sharp.

    Args:
        scales: Differences over 1, 2, 4, ... pixels.
    """

    def __init__(self, scales: int = 4) -> None:
        super().__init__()
        self.scales = scales

    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``(B,)``."""
        # Invalid targets may be NaN: set them to zero before differences spread them.
        r = torch.where(mask, log_depth - log_target, torch.zeros_like(log_depth))
        total = r.new_zeros(r.shape[0])
        for scale in range(self.scales):
            d = 2**scale
            if min(r.shape[-2:]) <= d:
                break
            dx, mx = r[..., :, d:] - r[..., :, :-d], mask[..., :, d:] & mask[..., :, :-d]
            dy, my = r[..., d:, :] - r[..., :-d, :], mask[..., d:, :] & mask[..., :-d, :]
            total = total + masked_mean(dx.abs(), mx) + masked_mean(dy.abs(), my)
        return total / self.scales


class LaplaceNll(nn.Module):
    """Negative log likelihood of a Laplace distribution: trains the uncertainty head.

    The residual is detached, so that the head describes the error without reducing its penalty.
    """

    def forward(self, log_sigma: Tensor, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``(B,)``; the standard deviation of a Laplace distribution is sqrt(2) times its scale."""
        log_b = log_sigma - 0.5 * torch.log(log_sigma.new_tensor(2.0))
        r = torch.where(mask, log_depth - log_target, torch.zeros_like(log_depth)).detach().abs()
        return masked_mean(r * torch.exp(-log_b) + log_b, mask)
