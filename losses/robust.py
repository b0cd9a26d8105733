"""Robust kernels on squared whitened residuals, with their iteratively-reweighted weights."""

import torch
from torch import Tensor

from edgeslam_torch.geometry.robust_statistics import Kernel

__all__ = ["Kernel", "rho"]


def rho(s: Tensor, kernel: Kernel, delta: float) -> tuple[Tensor, Tensor]:
    r"""Robust cost and its derivative, the weight of one reweighted least-squares step.

    Args:
        s: Squared whitened residuals, any shape, ``>= 0``.
        kernel: Shape; all behave like ``s`` near zero.
        delta: Where the kernel departs from ``s``, in standard deviations.

    Returns:
        ``rho(s)`` and ``rho'(s)``, shaped like ``s``.

    Example:
        >>> cost, weight = rho(torch.tensor([1.0, 16.0]), Kernel.HUBER, 2.0)
        >>> cost, weight
        (tensor([ 1., 12.]), tensor([1.0000, 0.5000]))
    """
    if kernel is Kernel.L2:
        return s, torch.ones_like(s)
    c2 = delta * delta
    if kernel is Kernel.HUBER:
        outside = s.clamp_min(c2).sqrt()
        return s.clamp_max(c2) + 2.0 * delta * (outside - delta), delta / outside
    if kernel is Kernel.CAUCHY:
        return c2 * torch.log1p(s / c2), c2 / (c2 + s)
    rest = (1.0 - s / c2).clamp_min(0.0)
    return c2 / 3.0 * (1.0 - rest**3), rest * rest
