"""Edge pixels of a batch of images on any device, for the losses that take pixels."""

import torch
from torch import Tensor

from edgeslam_torch.frontend.canny import canny_batch

RANGE_MARGIN = 0.5
"""How far interpolation and noise may carry images out of [0, 1]."""


def edge_pixels(
    images: Tensor, count: int, low: float = 50.0, high: float = 120.0, generator: torch.Generator | None = None
) -> Tensor:
    """Canny pixels drawn at random, without replacement.

    Args:
        images: ``(B, 1 or 3, H, W)`` in [0, 1].
        count: Pixels per image.
        low: Lower threshold [grey levels of the 3x3 Sobel gradient].
        high: Upper threshold [the same].
        generator: Of random numbers, on the images' device.

    Returns:
        ``(B, count, 2)`` [px], x first; NaN, which the losses leave out, where an image has fewer edges. No gradient.

    Raises:
        ValueError: If the images have another shape or range.
    """
    if images.ndim != 4 or images.shape[1] not in (1, 3):
        raise ValueError(f"images must be (B, 1 or 3, H, W), got {tuple(images.shape)}")
    darkest, brightest = images.detach().aminmax() if images.numel() else (0.0, 0.0)
    if not (images.is_floating_point() and darkest >= -RANGE_MARGIN and brightest <= 1.0 + RANGE_MARGIN):
        raise ValueError(
            f"images must be floats in [0, 1], got {images.dtype} from {float(darkest):g} to {float(brightest):g}; "
            f"divide grey levels by 255"
        )
    mask = canny_batch(images.detach().float(), low, high).flatten(1)
    # The largest of random keys, edges first, are a draw without replacement.
    key = torch.rand(mask.shape, generator=generator, device=images.device) + mask
    found, at = key.topk(min(count, mask.shape[1]), dim=1)
    width = images.shape[-1]
    uv = torch.stack((at % width, at // width), -1).to(torch.float32)
    uv = torch.where((found >= 1.0)[..., None] & mask.gather(1, at)[..., None], uv, torch.nan)
    return torch.nn.functional.pad(uv, (0, 0, 0, count - uv.shape[1]), value=torch.nan)
