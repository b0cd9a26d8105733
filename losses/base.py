"""The contract of every loss: signed residuals for Levenberg-Marquardt, one scalar for training."""

from enum import StrEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgeslam_torch.losses.robust import Kernel, rho


class Residuals(NamedTuple):
    """Signed, unreduced residuals."""

    value: Tensor
    """``(..., R)`` predicted minus observed, ``R`` rows per element; zero where not valid."""
    valid: Tensor
    """``(...)`` bool: element could be measured (in front, in the image, not occluded)."""


class Reduction(StrEnum):
    """How elements become a scalar."""

    SUM = "sum"
    """Sum over valid elements, as in the paper."""
    MEAN = "mean"
    """Mean over valid elements, so that masking does not lower the loss."""


class ResidualLoss(nn.Module):
    """Base of the losses: a subclass writes `residuals`, `forward` follows from it."""

    def __init__(self, reduction: Reduction = Reduction.MEAN, kernel: Kernel = Kernel.L2, delta: float = 1.0) -> None:
        """Choose how residuals are reduced.

        Args:
            reduction: Sum, or mean over the valid elements.
            kernel: Robust kernel on each element's squared norm.
            delta: Where the kernel departs from least squares, in the residual's unit.
        """
        super().__init__()
        if delta <= 0:
            raise ValueError(f"delta must be positive, got {delta}")
        self.reduction, self.kernel, self.delta = Reduction(reduction), Kernel(kernel), delta

    def residuals(self, *args: Tensor, **kwargs: Tensor) -> Residuals:
        """Per element, signed, unreduced; see the subclass."""
        raise NotImplementedError

    def forward(self, *args: Tensor, **kwargs: Tensor) -> Tensor:
        """Scalar loss ``()`` of the residuals; arguments as `residuals` takes them."""
        return reduce(self.residuals(*args, **kwargs), self.reduction, self.kernel, self.delta)


def reduce(residuals: Residuals, reduction: Reduction, kernel: Kernel = Kernel.L2, delta: float = 1.0) -> Tensor:
    """Sum or mean of robust squared norms over valid elements; zero, with a gradient, when there are none.

    Example:
        >>> r = Residuals(torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([True, False]))
        >>> reduce(r, Reduction.SUM)
        tensor(25.)
    """
    squared = residuals.value.square().sum(-1)
    cost, _ = rho(squared, kernel, delta)
    total = torch.where(residuals.valid, cost, 0.0).sum()
    if reduction is Reduction.SUM:
        return total
    return total / residuals.valid.sum().clamp_min(1)


def masked(value: Tensor, valid: Tensor) -> Residuals:
    """Residuals ``(..., R)`` with zeros (and zero gradients) where not valid."""
    return Residuals(torch.where(valid[..., None], value, 0.0), valid)


def back_project(uv: Tensor, depth_m: Tensor, K: Tensor) -> Tensor:
    r"""Camera-frame points of pixels at z-depth, paper eq. (17).

    .. math:: \mathbf{P} = d \, K^{-1} \mathbf{u}

    Args:
        uv: Pixels ``(..., 2)``.
        depth_m: z-depths ``(...)``.
        K: Calibration matrix ``(3, 3)`` [px].

    Returns:
        Points ``(..., 3)``.
    """
    xy = (uv - K[:2, 2]) / K.diagonal()[:2]
    return torch.cat((xy, torch.ones_like(xy[..., :1])), -1) * depth_m[..., None]


def project(p_c: Tensor, K: Tensor, min_depth: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Pixels ``(..., 2)`` of camera-frame points ``(..., 3)``, paper eqs. (1), (19), and which lie in front.

    Points behind the camera are projected from ``z = 1``: finite, with finite gradients, and marked invalid.
    """
    z = p_c[..., 2:]
    front = z > min_depth
    n = p_c[..., :2] / torch.where(front, z, 1.0)
    return n * K.diagonal()[:2] + K[:2, 2], front[..., 0]


def move(T: Tensor, p: Tensor) -> Tensor:
    """Points ``(..., N, 3)`` transformed by rigid motions ``(..., 4, 4)``."""
    return p @ T[..., :3, :3].mT + T[..., None, :3, 3]
