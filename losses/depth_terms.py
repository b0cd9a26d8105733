"""Training-only depth terms: each takes log depth ``(B, 1, H, W)`` and a mask, and returns one value per image.

Every ``forward`` takes

- ``log_depth``, predicted, and ``log_target``, observed ``(B, 1, H, W)`` [log m],
- ``mask``, where it is known ``(B, 1, H, W)`` bool,

and raises `ValueError` if shapes differ, `TypeError` if the mask is not bool.

Per-image means (not means over the batch's pixels) make the loss of a batch the mean of its images' losses, so the same
batch split over two processes gives the same gradient.

The mask is bool. Where it is False, prediction and target may be anything, NaN included. All have the same shape:
``(B, N)`` for samples will do, but for `GradientMatching`.
"""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from edgeslam_torch.losses.inputs import check_images, check_mask, in_full_precision

LOG_SQRT_2 = 0.5 * math.log(2.0)
"""Logarithm of a Laplace distribution's standard deviation over its scale."""


@in_full_precision
def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``x`` where ``mask``, per image: ``(B, ...) -> (B,)``; 0 for an image without a valid pixel.

    Raises:
        ValueError: If shapes differ.
        TypeError: If the mask is not bool.
    """
    check_images(x=x, mask=mask)
    check_mask(mask)
    return torch.where(mask, x, 0.0).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp(min=1)


def _residual(log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
    """Predicted minus observed where ``mask``, 0 elsewhere: what is not observed must not reach later operations,
    whose gradients of zero times NaN would be NaN."""
    check_images(log_depth=log_depth, log_target=log_target, mask=mask)
    check_mask(mask)
    return torch.where(mask, log_depth - log_target, 0.0)


class MaskedL1(nn.Module):
    """Mean absolute difference of log depth: a relative error, weighted equally near and far."""

    def __init__(self) -> None:
        super().__init__()

    @in_full_precision
    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """Mean over valid pixels ``(B,)``."""
        return masked_mean(_residual(log_depth, log_target, mask).abs(), mask)

    if TYPE_CHECKING:
        __call__ = forward


class BerHu(nn.Module):
    """Reverse Huber (Laina et al., 3DV 2016): linear below ``c``, quadratic above.

    Args:
        fraction: ``c`` is this fraction of the image's largest residual (0.2 in the paper).
    """

    def __init__(self, fraction: float = 0.2) -> None:
        super().__init__()
        self.fraction = fraction

    @in_full_precision
    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """Mean over valid pixels ``(B,)``."""
        r = _residual(log_depth, log_target, mask).abs()
        c = (self.fraction * r.flatten(1).amax(1)).clamp(min=1e-6).view(-1, *[1] * (r.ndim - 1))
        return masked_mean(torch.where(r <= c, r, (r * r + c * c) / (2 * c)), mask)

    if TYPE_CHECKING:
        __call__ = forward


class SILog(nn.Module):
    """Scale-invariant log error (Eigen et al., 2014): ``mean(r^2) - balance * mean(r)^2``.

    Args:
        balance: 1 ignores the scale entirely, 0 is the plain mean square; the paper trains with 0.5.
    """

    def __init__(self, balance: float = 0.5) -> None:
        super().__init__()
        self.balance = balance

    @in_full_precision
    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """Error over valid pixels ``(B,)``, squared [log m]."""
        r = _residual(log_depth, log_target, mask)
        return masked_mean(r * r, mask) - self.balance * masked_mean(r, mask).square()

    if TYPE_CHECKING:
        __call__ = forward


class LogSlope(nn.Module):
    """Distance from 1 of the slope of predicted log depth on observed log depth: below 1, far is predicted too near.

    The slope is that of the line of least squares through the valid pixels of an image. Scale does not count.

    Args:
        floor: Variance [log m squared] below which depth counts as constant: it regularises the slope towards 1.
    """

    def __init__(self, floor: float = 0.01) -> None:
        super().__init__()
        self.floor = floor

    @in_full_precision
    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """``|slope - 1|`` over valid pixels ``(B,)``."""
        r = _residual(log_depth, log_target, mask)
        t = torch.where(mask, log_target, 0.0)
        t = t - masked_mean(t, mask).view(-1, *[1] * (t.ndim - 1))
        return (masked_mean(t * r, mask) / (masked_mean(t * t, mask) + self.floor)).abs()

    if TYPE_CHECKING:
        __call__ = forward


class GradientMatching(nn.Module):
    """Absolute difference of the residual's gradients over several scales (MegaDepth, CVPR 2018): keeps edges sharp.

    Args:
        scales: Differences over 1, 2, 4, ... pixels.
    """

    def __init__(self, scales: int = 4) -> None:
        super().__init__()
        self.scales = scales

    @in_full_precision
    def forward(self, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """Mean over pairs of valid pixels ``(B,)``."""
        r = _residual(log_depth, log_target, mask)
        total = r.new_zeros(r.shape[0])
        for scale in range(self.scales):
            d = 2**scale
            if min(r.shape[-2:]) <= d:
                break
            dx, mx = r[..., :, d:] - r[..., :, :-d], mask[..., :, d:] & mask[..., :, :-d]
            dy, my = r[..., d:, :] - r[..., :-d, :], mask[..., d:, :] & mask[..., :-d, :]
            total = total + masked_mean(dx.abs(), mx) + masked_mean(dy.abs(), my)
        return total / self.scales

    if TYPE_CHECKING:
        __call__ = forward


class LaplaceNll(nn.Module):
    """Negative log likelihood of a Laplace distribution: trains the uncertainty head.

    The residual is detached, so that the head describes the error without reducing its penalty.
    """

    def __init__(self) -> None:
        super().__init__()

    @in_full_precision
    def forward(self, log_sigma: Tensor, log_depth: Tensor, log_target: Tensor, mask: Tensor) -> Tensor:
        """Mean over valid pixels ``(B,)``.

        Args:
            log_sigma: Predicted logarithm of the standard deviation of ``log_depth`` ``(B, 1, H, W)``; that of a
                Laplace distribution is sqrt(2) times its scale.
            log_depth, log_target, mask: As of the other terms; the prediction gets no gradient.
        """
        check_images(log_sigma=log_sigma, log_depth=log_depth)
        r = _residual(log_depth, log_target, mask).detach().abs()
        log_b = log_sigma.where(mask, 0.0) - LOG_SQRT_2
        return masked_mean(r * torch.exp(-log_b) + log_b, mask)

    if TYPE_CHECKING:
        __call__ = forward
