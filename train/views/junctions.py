"""L-junctions of a pair of images, in the format of the angle loss: a fixed number, padded with -1."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgeslam_torch.frontend.corners import JunctionConfig, detect_junctions
from edgeslam_torch.types import FloatArray

CONFIG = JunctionConfig(min_arm_px=10.0)
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
    found = detect_junctions(grey, np.asarray(cv2.Canny(grey, 50, 120), np.uint8), CONFIG)
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
