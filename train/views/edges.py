"""Edges for the losses: pixels of a batch on any device; pixels, straight pieces and L-junctions of an image."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgeslam_torch.frontend.canny import canny_batch
from edgeslam_torch.frontend.corners import JunctionConfig, detect_junctions
from edgeslam_torch.types import FloatArray

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


MIN_LENGTH_PX = 18
"""Minimum length of a segment."""
MAX_BEND_PX = 0.7
"""Maximum distance of a contour's pixel from its chord."""


def straight_edges(
    image: NDArray[np.uint8], edges: int, arms: int, points: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random samples of Canny pixels and of straight segments.

    Args:
        image: ``(H, W, 3)`` BGR.
        edges: Number of edge pixels.
        arms: Number of segments; even.
        points: Number of points on each segment.
        rng: Chooses pixels and segments.

    Returns:
        Pixels ``(edges, 2)`` and points ``(arms, points, 2)``, float32; padded with -1.
    """
    mask = np.asarray(cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 50, 120), np.uint8)
    v, u = np.nonzero(mask)
    pixels = np.full((edges, 2), -1.0, np.float32)
    if len(u):
        pick = rng.choice(len(u), min(edges, len(u)), replace=False)
        pixels[: len(pick)] = np.stack([u[pick], v[pick]], 1)
    pieces = np.full((arms, points, 2), -1.0, np.float32)
    found = _segments(mask)
    if found:
        for row, k in enumerate(rng.permutation(len(found))[:arms]):
            a, b = found[k]
            pieces[row] = a + np.linspace(0.05, 0.95, points)[:, None] * (b - a)
    return pixels, pieces


def _segments(mask: NDArray[np.uint8]) -> list[tuple[FloatArray, FloatArray]]:
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in contours:
        if len(contour) < MIN_LENGTH_PX:
            continue
        corners = cv2.approxPolyDP(contour, MAX_BEND_PX, closed=False)[:, 0].astype(np.float32)
        for a, b in zip(corners, corners[1:], strict=False):
            if np.hypot(*(b - a)) >= MIN_LENGTH_PX:
                found.append((a, b))
    return found


JUNCTIONS = JunctionConfig(min_arm_px=10.0)
"""The images are small."""
ARM_PX = 30.0
"""Longest piece of an arm that is used."""
REACH_PX = 6.0
"""Largest distance of a projected corner from the one it is taken for."""
TURN_COS = float(np.cos(np.radians(25.0)))
"""Of the largest mean turn of its arms."""


def junction_points(image: NDArray[np.uint8], most: int) -> FloatArray:
    """Corner and the ends of its two arms ``(most, 3, 2)`` float32 [px] of the longest L-junctions of a BGR image."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    found = detect_junctions(grey, np.asarray(cv2.Canny(grey, 50, 120), np.uint8), JUNCTIONS)
    out = np.full((most, 3, 2), -1.0, np.float32)
    n = min(most, len(found))
    reach = np.minimum(found.length_px[:n], ARM_PX)[..., None]
    out[:n, 0] = found.uv[:n]
    out[:n, 1:] = found.uv[:n, None] + found.arms[:n] * reach
    return out


def seen_cosines(projected: Tensor, seen: Tensor) -> Tensor:
    """Cosine of the angle that frame j sees at each junction of frame i.

    Args:
        projected: Corner and arm ends ``(C, 3, 2)`` of frame i where its depth puts them in frame j [px].
        seen: Those that frame j has ``(D, 3, 2)``, padded with -1.

    Returns:
        ``(C,)``; NaN where frame j has no such junction near.
    """
    arms_i, arms_j = _arms(projected), _arms(seen)
    apart = torch.cdist(projected[:, 0], seen[:, 0])
    alike = torch.einsum("cad,ebd->ceab", arms_i, arms_j)
    straight, crossed = (alike[..., 0, 0] + alike[..., 1, 1]) / 2, (alike[..., 0, 1] + alike[..., 1, 0]) / 2
    fits = (apart < REACH_PX) & (torch.maximum(straight, crossed) > TURN_COS) & (seen[:, 0, 0] >= 0)
    distance, best = torch.where(fits, apart, torch.inf).min(1)
    cosine = (arms_j[:, 0] * arms_j[:, 1]).sum(-1)[best]
    return torch.where(distance.isfinite(), cosine, torch.nan)


def _arms(points: Tensor) -> Tensor:
    return torch.nn.functional.normalize(points[:, 1:] - points[:, :1], dim=-1)
