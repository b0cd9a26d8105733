"""The contract of every loss: signed residuals for Levenberg-Marquardt, one number an item for training.

Inputs without a batch axis give a scalar ``()``, batches ``(B, ...)`` one value an item ``(B,)``. What was not observed
(outside a mask, NaN or infinity in an observation) is left out, with a gradient of zero whatever stands there. What is
not finite in a prediction that counts, or larger than 4e9 in float32 (`in_full_precision`), gives NaN (the terms of
`depth_terms` may give infinity): a network that has diverged is seen. A finite loss has finite gradients. Half inputs
are computed, and returned, in float32.
"""

from enum import StrEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from edgeslam_torch.losses.robust import Kernel, rho

MIN_FOCAL_PX = 1e-6
"""Focal lengths below it calibrate nothing."""


class Residuals(NamedTuple):
    """Signed, unreduced residuals."""

    value: Tensor
    """``(..., R)`` predicted minus observed, ``R`` rows per element; zero where not valid."""
    valid: Tensor
    """``(...)`` bool: element could be measured (in front, in the image, not occluded)."""


class Reduction(StrEnum):
    """How elements become one number."""

    SUM = "sum"
    """Sum over valid elements, as in the paper."""
    MEAN = "mean"
    """Mean over valid elements, so that masking does not lower the loss."""


class ResidualLoss(nn.Module):
    """Base of the losses: a subclass writes ``residuals``, and ``forward`` as their reduction."""

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

    def reduced(self, residuals: Residuals, axes: int) -> Tensor:
        """Residuals reduced over the last ``axes`` axes of elements: ``()``, or ``(B,)`` for a batch."""
        return reduce(residuals, self.reduction, self.kernel, self.delta, axes)


def reduce(
    residuals: Residuals,
    reduction: Reduction,
    kernel: Kernel = Kernel.L2,
    delta: float = 1.0,
    axes: int | None = None,
) -> Tensor:
    """Sum or mean of robust squared norms over valid elements; zero, with a gradient, when there are none.

    Args:
        residuals: With elements ``(..., E1, ..., En)``.
        reduction: Sum or mean.
        kernel: Robust kernel.
        delta: Where it departs from least squares.
        axes: How many axes are elements' (``n``), the others being the batch's; all by default.

    Returns:
        ``(...)``.

    Example:
        >>> r = Residuals(torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([True, False]))
        >>> reduce(r, Reduction.SUM)
        tensor(25.)
    """
    squared = residuals.value.square().sum(-1)
    cost, _ = rho(squared, kernel, delta)
    valid = residuals.valid
    over = tuple(range(-(valid.ndim if axes is None else axes), 0))
    total = torch.where(valid, cost, 0.0).sum(over)
    if reduction is Reduction.SUM:
        return total
    return total / valid.sum(over).clamp_min(1)


def masked(value: Tensor, valid: Tensor, lost: Tensor | None = None) -> Residuals:
    """Residuals ``(..., R)`` with zeros (and zero gradients) where not valid.

    Args:
        value: Residuals ``(..., R)``.
        valid: Which count ``(...)``.
        lost: Elements whose prediction is not finite ``(...)``, from `lost_of`: they count, as NaN.
    """
    value = torch.where(valid[..., None], value, 0.0)
    if lost is None:
        return Residuals(value, valid)
    return Residuals(torch.where(lost[..., None], torch.nan, value), valid | lost)


def lost_of(seen: Tensor, K: Tensor, *predicted: Tensor) -> Tensor:
    """Which observed elements ``(..., N)`` have a prediction ``(..., N, D)`` that is not finite, or no calibration."""
    return seen & ~(torch.cat(predicted, -1).isfinite().all(-1) & calibrates(K)[..., None])


def calibrates(K: Tensor) -> Tensor:
    """Which matrices ``(..., 3, 3)`` are finite with focal lengths that can be divided by ``(...)``."""
    return K.isfinite().all((-1, -2)) & (K.diagonal(dim1=-2, dim2=-1)[..., :2].abs() > MIN_FOCAL_PX).all(-1)


def back_project(uv: Tensor, depth_m: Tensor, K: Tensor) -> Tensor:
    r"""Camera-frame points of pixels at z-depth, paper eq. (17).

    .. math:: \mathbf{P} = d \, K^{-1} \mathbf{u}

    Args:
        uv: Pixels ``(..., 2)``.
        depth_m: z-depths ``(...)``.
        K: Calibration matrix ``(3, 3)`` [px]; ``(..., 3, 3)``, one an item, for pixels ``(..., N, 2)``.

    Returns:
        Points ``(..., 3)``.
    """
    focal, centre = _intrinsics(K)
    xy = (uv - centre) / focal
    return torch.cat((xy, torch.ones_like(xy[..., :1])), -1) * depth_m[..., None]


def project(p_c: Tensor, K: Tensor, min_depth: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Pixels ``(..., 2)`` of camera-frame points ``(..., 3)``, paper eqs. (1), (19), and which lie in front.

    Points behind the camera are projected from ``z = 1``: finite, with finite gradients, and marked invalid.
    ``K`` as in `back_project`.
    """
    z = p_c[..., 2:]
    front = z > min_depth
    n = p_c[..., :2] / torch.where(front, z, 1.0)
    focal, centre = _intrinsics(K)
    return n * focal + centre, front[..., 0]


def move(T: Tensor, p: Tensor) -> Tensor:
    """Points ``(..., N, 3)`` transformed by rigid motions ``(..., 4, 4)``."""
    return p @ T[..., :3, :3].mT + T[..., None, :3, 3]


def _intrinsics(K: Tensor) -> tuple[Tensor, Tensor]:
    """Focal lengths and principal point, ``(2,)`` or ``(..., 1, 2)`` each; NaN without a calibration."""
    K = K.where(calibrates(K)[..., None, None], torch.nan)
    focal, centre = K.diagonal(dim1=-2, dim2=-1)[..., :2], K[..., :2, 2]
    return (focal, centre) if K.ndim == 2 else (focal[..., None, :], centre[..., None, :])
