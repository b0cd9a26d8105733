"""Photometric reprojection for self-supervised depth (Godard et al., ICCV 2019): training only."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SSIM_WEIGHT = 0.85
_C1, _C2 = 0.01**2, 0.03**2
"""Stabilisers of SSIM for images in [0, 1] (Wang et al., 2004)."""


def warp_to(image_j: Tensor, depth_i: Tensor, T_j_i: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """View i synthesised from frame j.

    Args:
        image_j: ``(B, 3, H, W)`` in [0, 1].
        depth_i: z-depth of view i ``(B, 1, H, W)`` [same unit as ``T_j_i``].
        T_j_i: Camera i to camera j ``(B, 4, 4)``.
        K: Intrinsics of both ``(B, 3, 3)`` [px].

    Returns:
        Warped image ``(B, 3, H, W)`` and where it is valid (in front, inside) ``(B, 1, H, W)``.
    """
    B, _, H, W = depth_i.shape
    v, u = torch.meshgrid(
        torch.arange(H, dtype=depth_i.dtype, device=depth_i.device),
        torch.arange(W, dtype=depth_i.dtype, device=depth_i.device),
        indexing="ij",
    )
    pixels = torch.stack((u, v, torch.ones_like(u))).reshape(1, 3, -1)
    p_i = torch.linalg.solve(K, pixels.expand(B, -1, -1)) * depth_i.reshape(B, 1, -1)
    p_j = T_j_i[:, :3, :3] @ p_i + T_j_i[:, :3, 3:]
    z = p_j[:, 2:].clamp(min=1e-3)
    uv = (K @ (p_j / z))[:, :2]
    grid = torch.stack((2 * uv[:, 0] / (W - 1) - 1, 2 * uv[:, 1] / (H - 1) - 1), -1).reshape(B, H, W, 2)
    valid = (grid.abs() <= 1).all(-1) & (p_j[:, 2] > 1e-3).reshape(B, H, W)
    # Values far outside would overflow float32 in the sampler's derivative.
    warped = F.grid_sample(image_j, grid.clamp(-2, 2), padding_mode="border", align_corners=True)
    return warped, valid[:, None]


def dissimilarity(a: Tensor, b: Tensor) -> Tensor:
    """``0.85 (1 - SSIM) / 2 + 0.15 |a - b|`` per pixel, mean over colours: ``(B, 3, H, W)`` twice -> ``(B,
    1, H, W)``."""
    l1 = (a - b).abs().mean(1, keepdim=True)
    x, y = F.pad(a, (1, 1, 1, 1), mode="reflect"), F.pad(b, (1, 1, 1, 1), mode="reflect")
    mx, my = F.avg_pool2d(x, 3, 1), F.avg_pool2d(y, 3, 1)
    vx = (F.avg_pool2d(x * x, 3, 1) - mx * mx).clamp(min=0)
    vy = (F.avg_pool2d(y * y, 3, 1) - my * my).clamp(min=0)
    vxy = F.avg_pool2d(x * y, 3, 1) - mx * my
    ssim = ((2 * mx * my + _C1) * (2 * vxy + _C2)) / ((mx * mx + my * my + _C1) * (vx + vy + _C2))
    distance = ((1 - ssim) / 2).clamp(0, 1).mean(1, keepdim=True)
    return SSIM_WEIGHT * distance + (1 - SSIM_WEIGHT) * l1


class PhotometricLoss(nn.Module):
    """Smallest dissimilarity over the source frames; pixels that match better without motion are masked."""

    def forward(self, image_i: Tensor, images_j: Tensor, depth_i: Tensor, T_j_i: Tensor, K: Tensor) -> Tensor:
        """Mean per image ``(B,)``.

        Args:
            image_i: ``(B, 3, H, W)`` in [0, 1].
            images_j: Source frames ``(B, S, 3, H, W)``.
            depth_i: ``(B, 1, H, W)``.
            T_j_i: ``(B, S, 4, 4)``.
            K: ``(B, 3, 3)``.
        """
        costs, still = [], []
        for s in range(images_j.shape[1]):
            warped, valid = warp_to(images_j[:, s], depth_i, T_j_i[:, s], K)
            cost = dissimilarity(warped, image_i)
            costs.append(torch.where(valid, cost, torch.full_like(cost, 1e3)))
            still.append(dissimilarity(images_j[:, s], image_i))
        best, unmoved = torch.stack(costs).amin(0), torch.stack(still).amin(0)
        mask = (best < unmoved.detach()) & (best < 1e2)
        return (torch.where(mask, best, 0.0).flatten(1).sum(1)) / mask.flatten(1).sum(1).clamp(min=1)


class SmoothnessLoss(nn.Module):
    """Second-order smoothness of log depth where the image is smooth; planes in log depth are free."""

    def forward(self, log_depth: Tensor, image: Tensor) -> Tensor:
        """``(B, 1, H, W)`` and ``(B, 3, H, W)`` -> ``(B,)``."""
        total = log_depth.new_zeros(log_depth.shape[0])
        for dim in (-1, -2):
            bend = log_depth.diff(n=2, dim=dim).abs()
            contrast = image.diff(dim=dim).abs().mean(1, keepdim=True)
            n = contrast.shape[dim] - 1
            weight = torch.exp(-10.0 * torch.maximum(contrast.narrow(dim, 0, n), contrast.narrow(dim, 1, n)))
            total = total + (bend * weight).flatten(1).mean(1)
        return total
