"""Which keypoints are corners, by the structure tensor; the others slide along a straight edge (aperture problem).

FAST also finds keypoints on plain edges, such as the joint of two wall panels. Their matches are right across the edge
and pixels off along it, where the nearest of many look-alikes is taken: what they slide by looks like motion, hundreds
fit an essential matrix with a sharp minimum, and a map that follows them agrees with itself.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray

MIN_EIGENVALUE_RATIO = 0.1
"""Minimum ratio of the structure tensor's eigenvalues on a corner (Lowe, IJCV 2004, section 4.1)."""
_WINDOW = 5
"""Half width of the tensor's window [px of the keypoint's pyramid level]."""
_BLUR_PX = 1.0
"""Smoothing before: the stairs of a slanted line would be corners."""


def are_corners(grey: NDArray[np.uint8], uv: FloatArray, scale: FloatArray) -> NDArray[np.bool_]:
    """Mask ``(N,)`` of keypoints that lie on corners.

    Args:
        grey: Image ``(H, W)``.
        uv: Pixels in it ``(N, 2)``, float32.
        scale: Size of a pixel of their pyramid levels ``(N,)`` [px].

    Example:
        >>> panels = np.zeros((40, 40), np.uint8)
        >>> panels[:, 20:] = 200
        >>> panels[20:, 20:] = 100
        >>> are_corners(panels, np.array([[20, 10], [20, 20]], np.float32), np.ones(2)).tolist()
        [False, True]
    """
    smooth = np.asarray(cv2.GaussianBlur(grey, (5, 5), _BLUR_PX), dtype=np.uint8)
    return np.asarray(_eigenvalue_ratio(smooth, uv, scale) > MIN_EIGENVALUE_RATIO)


@compiled("u1[:,::1], f4[:,::1], f8[::1]")
def _eigenvalue_ratio(grey: NDArray[np.uint8], uv: FloatArray, scale: FloatArray) -> FloatArray:
    """Smaller by larger eigenvalue ``(N,)`` of the structure tensor: 0 on a straight edge, 1 on an isotropic corner.

    Args:
        grey: Smoothed image ``(H, W)``.
        uv: Keypoints ``(N, 2)``.
        scale: ``(N,)`` of their octaves, the distance of samples [px].
    """
    height, width = grey.shape
    ratio = np.zeros(len(uv))
    for n in range(len(uv)):
        a, b, c, step = 0.0, 0.0, 0.0, scale[n]
        for i in range(-_WINDOW, _WINDOW + 1):
            above = min(max(int(uv[n, 1] + (i - 1) * step + 0.5), 0), height - 1)
            at = min(max(int(uv[n, 1] + i * step + 0.5), 0), height - 1)
            below = min(max(int(uv[n, 1] + (i + 1) * step + 0.5), 0), height - 1)
            for j in range(-_WINDOW, _WINDOW + 1):
                left = min(max(int(uv[n, 0] + (j - 1) * step + 0.5), 0), width - 1)
                here = min(max(int(uv[n, 0] + j * step + 0.5), 0), width - 1)
                right = min(max(int(uv[n, 0] + (j + 1) * step + 0.5), 0), width - 1)
                x = float(grey[at, right]) - float(grey[at, left])
                y = float(grey[below, here]) - float(grey[above, here])
                a += x * x
                b += x * y
                c += y * y
        spread = math.sqrt((a - c) * (a - c) + 4.0 * b * b)
        ratio[n] = (a + c - spread) / max(a + c + spread, 1.0)
    return ratio
