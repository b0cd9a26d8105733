"""Photometric reprojection for self-supervised depth (Godard et al., ICCV 2019): training only.

SSIM and warp are own ones: kornia's are slower, and its warp does not say which pixels it could see
(docs/decisions/10-canny.md). Tests hold them together.
"""

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edgeslam_torch.losses.base import back_project, calibrates, move, project
from edgeslam_torch.losses.depth_terms import masked_mean
from edgeslam_torch.losses.inputs import check_shapes, in_full_precision
from edgeslam_torch.losses.sampling import finite_part, sample

SSIM_WEIGHT = 0.85
_C1, _C2 = 0.01**2, 0.03**2
"""Stabilisers of SSIM for images in [0, 1] (Wang et al., 2004)."""
NEAREST = 1e-3
"""Smallest depth in the other frame, in the depth's unit."""
ROUNDING_PX = 0.01
"""How far outside a pixel still counts as inside: a camera that moves sideways leaves the first and the last row on the
border itself, and rounding would choose which of their pixels count."""


@in_full_precision
def warp_to(image_j: Tensor, depth_i: Tensor, T_j_i: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """View i synthesised from frame j.

    Args:
        image_j: ``(B, 3, H, W)`` in [0, 1].
        depth_i: z-depth of view i ``(B, 1, H, W)`` [same unit as ``T_j_i``]; 0 where unknown.
        T_j_i: Camera i to camera j ``(B, 4, 4)``.
        K: Intrinsics of both ``(B, 3, 3)`` [px].

    Returns:
        Warped image ``(B, 3, H, W)`` and where it is valid (finite, known, in front, inside) ``(B, 1, H, W)``.
    """
    warped, valid, whole = _warped(image_j, depth_i, T_j_i, K)
    return warped, valid & whole


def _warped(image_j: Tensor, depth_i: Tensor, T_j_i: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`warp_to` with two masks: valid pixels, and those that touch no hole of ``image_j``."""
    B, _, H, W = depth_i.shape
    v, u = torch.meshgrid(
        torch.arange(H, dtype=depth_i.dtype, device=depth_i.device),
        torch.arange(W, dtype=depth_i.dtype, device=depth_i.device),
        indexing="ij",
    )
    pixels = torch.stack((u, v), -1).reshape(1, -1, 2)
    depth = depth_i.flatten(1)
    known = (depth > 0) & depth.isfinite()
    p_j = move(T_j_i, back_project(pixels, depth.where(known, 1.0), K))
    uv, front = project(p_j, K, NEAREST)
    size = uv.new_tensor((W - 1, H - 1))
    valid = (known & front & ((uv >= -ROUNDING_PX) & (uv <= size + ROUNDING_PX)).all(-1)).reshape(B, 1, H, W)
    # Values far outside would overflow float32 in the sampler's derivative.
    grid = (2.0 * uv / size - 1.0).clamp(-2, 2).reshape(B, H, W, 2)
    image, seen = finite_part(image_j)
    hole = (~seen).any(1, keepdim=True).to(image.dtype)
    out = sample(torch.cat((image, hole), 1), grid)
    return out[:, :-1], valid, out[:, -1:] == 0


@in_full_precision
def dissimilarity(a: Tensor, b: Tensor) -> Tensor:
    """``0.85 (1 - SSIM) / 2 + 0.15 |a - b|`` per pixel, mean over colours: ``(B, 3, H, W)`` twice, ``(B, 1, H, W)``."""
    l1 = (a - b).abs().mean(1, keepdim=True)
    distance = ((1 - ssim(a, b)) / 2).clamp(0, 1).mean(1, keepdim=True)
    return SSIM_WEIGHT * distance + (1 - SSIM_WEIGHT) * l1


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity in windows of 3 x 3 pixels: images ``(B, C, H, W)`` in [0, 1], and as much out."""
    x, y = F.pad(a, (1, 1, 1, 1), mode="reflect"), F.pad(b, (1, 1, 1, 1), mode="reflect")
    mx, my = F.avg_pool2d(x, 3, 1), F.avg_pool2d(y, 3, 1)
    vx = (F.avg_pool2d(x * x, 3, 1) - mx * mx).clamp(min=0)
    vy = (F.avg_pool2d(y * y, 3, 1) - my * my).clamp(min=0)
    vxy = F.avg_pool2d(x * y, 3, 1) - mx * my
    return ((2 * mx * my + _C1) * (2 * vxy + _C2)) / ((mx * mx + my * my + _C1) * (vx + vy + _C2))


class PhotometricLoss(nn.Module):
    """Smallest dissimilarity over the source frames; pixels that match better without motion are masked."""

    def __init__(self) -> None:
        super().__init__()

    @in_full_precision
    def forward(self, image_i: Tensor, images_j: Tensor, depth_i: Tensor, T_j_i: Tensor, K: Tensor) -> Tensor:
        """Mean per image ``(B,)``; NaN for a depth or motion that is not finite.

        Args:
            image_i: ``(B, 3, H, W)`` in [0, 1]; NaN or infinite where not observed, as in the source frames.
            images_j: Source frames ``(B, S, 3, H, W)``.
            depth_i: Predicted z-depth ``(B, 1, H, W)`` [m, or the motions' unit]; 0 where unknown.
            T_j_i: Motions from frame i to the source frames ``(B, S, 4, 4)``.
            K: Calibration matrix of all ``(B, 3, 3)`` [px].

        Raises:
            ValueError: If shapes do not fit.
        """
        check_shapes(
            image_i=(image_i, "B 3 H W"),
            images_j=(images_j, "B S 3 H W"),
            depth_i=(depth_i, "B 1 H W"),
            T_j_i=(T_j_i, "B S 4 4"),
            K=(K, "B 3 3"),
        )
        image_i, seen_i = finite_part(image_i)
        costs, still = [], []
        lost = ~((depth_i <= 0) | depth_i.isfinite()).flatten(1).all(1)
        lost = lost | ~(T_j_i.isfinite().flatten(1).all(1) & calibrates(K))
        for s in range(images_j.shape[1]):
            warped, valid, whole = _warped(images_j[:, s], depth_i, T_j_i[:, s], K)
            image_j, seen_j = finite_part(images_j[:, s])
            valid = valid & _windows((whole & seen_i & seen_j).all(1, keepdim=True))
            cost, unmoved = dissimilarity(warped, image_i), dissimilarity(image_j, image_i)
            lost = lost | ~(cost.isfinite() & unmoved.isfinite()).flatten(1).all(1)
            costs.append(torch.where(valid, cost, 1e3))
            still.append(unmoved)
        best, unmoved = torch.stack(costs).amin(0), torch.stack(still).amin(0)
        mask = (best < unmoved.detach()) & (best < 1e2)
        mean = torch.where(mask, best, 0.0).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp(min=1)
        return torch.where(lost, torch.nan, mean)

    if TYPE_CHECKING:
        __call__ = forward


def _windows(whole: Tensor) -> Tensor:
    """Pixels ``(B, 1, H, W)`` whose window of 3 x 3 pixels is whole."""
    return F.max_pool2d((~whole).float(), 3, 1, 1) == 0


class SmoothnessLoss(nn.Module):
    """Second-order smoothness of log depth where the image is smooth; planes in log depth are free."""

    def __init__(self) -> None:
        super().__init__()

    @in_full_precision
    def forward(self, log_depth: Tensor, image: Tensor) -> Tensor:
        """Mean per image ``(B,)``.

        Args:
            log_depth: Predicted ``(B, 1, H, W)`` [log m].
            image: ``(B, 3, H, W)`` in [0, 1]; NaN or infinite where not observed.

        Raises:
            ValueError: If shapes do not fit.
        """
        check_shapes(log_depth=(log_depth, "B 1 H W"), image=(image, "B 3 H W"))
        image, seen = finite_part(image)
        seen = seen.all(1, keepdim=True)
        total = log_depth.new_zeros(log_depth.shape[0])
        for dim in (-1, -2):
            bend = log_depth.diff(n=2, dim=dim).abs()
            contrast = image.diff(dim=dim).abs().mean(1, keepdim=True)
            n = contrast.shape[dim] - 1
            weight = torch.exp(-10.0 * torch.maximum(contrast.narrow(dim, 0, n), contrast.narrow(dim, 1, n)))
            known = seen.narrow(dim, 0, n) & seen.narrow(dim, 1, n) & seen.narrow(dim, 2, n)
            total = total + masked_mean(bend.where(known, 0.0) * weight, known)
        return total

    if TYPE_CHECKING:
        __call__ = forward
