"""Values of images and maps between their pixels."""

import torch.nn.functional as F
from torch import Tensor

FAR = 1e4
"""Normalised coordinates [half images] beyond which a place is moved nearer: no padding differs there, and larger
numbers overflow the sampler's integers."""


def sample(
    maps: Tensor, grid: Tensor, mode: str = "bilinear", padding_mode: str = "border", align_corners: bool = True
) -> Tensor:
    """`torch.nn.functional.grid_sample` for any numbers.

    Torch's own reads and writes outside its memory where the grid is not finite, which ends the process.

    Args:
        maps: ``(B, C, H, W)``.
        grid: Places ``(B, h, w, 2)``, x first, -1 to 1 over the image; what is not finite is sampled in the middle,
            without a gradient: callers mask it.
        mode: As torch has it.
        padding_mode: As torch has it.
        align_corners: As torch has it: whether -1 and 1 are the outer pixels' centres or their outer borders.

    Returns:
        ``(B, C, h, w)``.
    """
    safe = grid.where(grid.isfinite(), 0.0).clamp(-FAR, FAR)
    return F.grid_sample(maps, safe, mode=mode, padding_mode=padding_mode, align_corners=align_corners)


def finite_part(x: Tensor) -> tuple[Tensor, Tensor]:
    """What is finite of observations, 0 elsewhere (with no gradient), and where it is finite."""
    finite = x.isfinite()
    return x.where(finite, 0.0), finite
