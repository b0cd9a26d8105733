"""Many views at once as tensors, turned, zoomed and recoloured on the device that they lie on.

The same virtual cameras and colours as in `augment`, a view at a time there. All chance comes from numpy's generator,
so that the same seed draws the same views on every device.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from edgeslam_torch.losses.sampling import sample
from edgeslam_torch.train.views.augment import AugmentConfig, View, fitted_view, virtual_camera
from edgeslam_torch.types import FloatArray

KERNEL_PX = 9
"""Side of all blur kernels."""
_LUMA = (0.299, 0.587, 0.114)
"""Grey from RGB (ITU-R BT.601)."""


@dataclass(frozen=True, slots=True)
class Views:
    """Images with their depth and cameras, all of one size, on one device."""

    image: Tensor
    """``(N, 3, H, W)`` uint8 RGB."""
    depth_m: Tensor
    """``(N, 1, H, W)`` float16, 0 where unknown [m]: to .05 %."""
    K: FloatArray
    """``(N, 3, 3)`` intrinsics [px], in main memory."""

    def __len__(self) -> int:
        return len(self.K)

    def of(self, rows: Sequence[int]) -> "Views":
        """Those at ``rows``, in this order."""
        index = torch.as_tensor(rows, dtype=torch.long, device=self.image.device)
        return Views(self.image[index], self.depth_m[index], self.K[np.asarray(rows, np.int64)])


def on_device(views: Sequence[View], size: tuple[int, int], device: torch.device) -> Views:
    """The views squeezed to ``size = (height, width)``, on the device."""
    fitted = [fitted_view(view, size) for view in views]
    images = torch.from_numpy(np.stack([view.image[..., ::-1].transpose(2, 0, 1) for view in fitted]))
    depths = torch.from_numpy(np.stack([view.depth_m[None] for view in fitted]).astype(np.float16))
    return Views(images.to(device), depths.to(device), np.stack([view.K for view in fitted]))


def joined(parts: Sequence[Views]) -> Views:
    """All of them, in order."""
    return Views(
        torch.cat([part.image for part in parts]),
        torch.cat([part.depth_m for part in parts]),
        np.concatenate([part.K for part in parts]),
    )


def random_views(
    views: Views, size: tuple[int, int], config: AugmentConfig, rng: np.random.Generator
) -> tuple[Tensor, Tensor, FloatArray]:
    """What virtual cameras of ``size = (height, width)`` at the same places see.

    Returns:
        ``(B, 3, height, width)`` float32 RGB in [0, 1], depth ``(B, 1, height, width)`` float32 [m] with 0 where it is
        unknown, and focal lengths ``(B,)`` [px].
    """
    shape = views.image.shape[-2:]
    cameras = [virtual_camera(K, (int(shape[0]), int(shape[1])), size, config, rng) for K in views.K]
    K, R = np.stack([k for k, _ in cameras]), np.stack([r for _, r in cameras])
    image, depth = warped(views, K, R, size)
    mirrored = _on(rng.random(len(K)) < config.flip, image)
    image = torch.where(mirrored, image.flip(-1), image)
    depth = torch.where(mirrored, depth.flip(-1), depth)
    return recoloured(image, config, rng), depth, np.sqrt(K[:, 0, 0] * K[:, 1, 1])


def warped(views: Views, K: FloatArray, R: FloatArray, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The views through intrinsics ``K (B, 3, 3)`` of ``size``, turned by ``R (B, 3, 3)`` (old camera to new camera
    coordinates): image in [0, 1], linear and reflected at its borders, and z-depth [m] by the nearest pixel, 0 beyond.
    """
    height, width = size
    h, w = views.image.shape[-2:]
    device = views.image.device
    v, u = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(-1, 3).double()
    turned = np.swapaxes(R, 1, 2) @ np.linalg.inv(K)  # new pixels to rays in the old camera
    rays = pixels @ torch.from_numpy(turned).to(device).mT
    old = rays @ torch.from_numpy(views.K).to(device).mT
    uv = (old[..., :2] / old[..., 2:].clamp(min=1e-6)).float()
    grid = ((2 * uv + 1) / torch.tensor([w, h], device=device) - 1).view(-1, height, width, 2)
    image = sample(views.image.float() / 255, grid, padding_mode="reflection", align_corners=False)
    depth = sample(views.depth_m.float(), grid, mode="nearest", padding_mode="zeros", align_corners=False)
    return image, depth / rays[..., 2].float().view(-1, 1, height, width).clamp(min=0.1)


def recoloured(image: Tensor, config: AugmentConfig, rng: np.random.Generator) -> Tensor:
    """Colours, contrast, blur and noise of other cameras; ``(B, 3, H, W)`` in [0, 1]."""
    count = len(image)

    def drawn(low: float, high: float, channels: int = 1) -> Tensor:
        return _on(rng.uniform(low, high, (count, channels)), image)

    grey = _on(rng.random(count) < config.grey, image)
    luma = (image * image.new_tensor(_LUMA).view(3, 1, 1)).sum(1, keepdim=True)
    coloured = luma + (image - luma) * drawn(1 - config.saturation, 1 + config.saturation)
    coloured = coloured * drawn(1 - config.channel, 1 + config.channel, 3)
    x = torch.where(grey, luma.expand_as(image), coloured)
    mean = x.mean((1, 2, 3), keepdim=True)
    x = (x - mean) * drawn(1 - config.contrast, 1 + config.contrast) + mean
    x = (x * drawn(1 - config.brightness, 1 + config.brightness)).clamp(0, 1) ** drawn(*config.gamma)
    kernels = np.stack([_kernel(rng) if rng.random() < config.blur else _still() for _ in range(count)])
    x = _blurred(x, _on(kernels, x).view(count, KERNEL_PX, KERNEL_PX))
    sigma = _on(np.where(rng.random(count) < config.noise, rng.uniform(0.005, 0.04, count), 0.0), x)
    generator = torch.Generator(x.device).manual_seed(int(rng.integers(2**62)))
    x = x + sigma * torch.randn(x.shape, generator=generator, device=x.device)
    return x.clamp(0, 1)


def _on(values: np.ndarray, like: Tensor) -> Tensor:
    """``(B,)`` or ``(B, C)`` as ``(B, C or 1, 1, 1)`` on the tensor's device; kernels keep all their values."""
    tensor = torch.from_numpy(values if values.dtype == bool else values.astype(np.float32))
    return tensor.reshape(len(values), -1, 1, 1).to(like.device, non_blocking=True)


def _blurred(x: Tensor, kernels: Tensor) -> Tensor:
    count, channels, height, width = x.shape
    half = KERNEL_PX // 2
    padded = functional.pad(x, (half, half, half, half), mode="reflect").view(1, count * channels, *_grown(x, half))
    weight = kernels[:, None, None].expand(-1, channels, -1, -1, -1).reshape(count * channels, 1, KERNEL_PX, KERNEL_PX)
    return functional.conv2d(padded, weight, groups=count * channels).view(count, channels, height, width)


def _grown(x: Tensor, by: int) -> tuple[int, int]:
    return x.shape[-2] + 2 * by, x.shape[-1] + 2 * by


def _offsets() -> tuple[FloatArray, FloatArray]:
    """Row and column of the kernel's pixels from its centre [px]."""
    v, u = np.mgrid[:KERNEL_PX, :KERNEL_PX] - (KERNEL_PX - 1) / 2
    return v, u


def _still() -> FloatArray:
    v, u = _offsets()
    return ((v == 0) & (u == 0)).astype(np.float64)


def _kernel(rng: np.random.Generator) -> FloatArray:
    """Half of them out of focus, half of them along a line as motion blurs."""
    v, u = _offsets()
    if rng.random() < 0.5:
        kernel = np.exp(-(u**2 + v**2) / (2 * rng.uniform(0.4, 1.5) ** 2))
    else:
        angle, half = rng.uniform(0, np.pi), rng.uniform(1.0, 3.5)
        along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
        kernel = np.clip(half + 0.5 - np.abs(along), 0, 1) * np.clip(1 - np.abs(across), 0, 1)
    return np.asarray(kernel / kernel.sum())
