"""Selection of keypoints that are corners by the structure tensor; the others slide along an edge (aperture problem).

Least squares on grey levels locates a patch with covariance ``s^2 S^-1``, where ``S`` is the sum of ``grad grad^T``
over it (Förstner and Gülch, 1987). FAST also finds keypoints on plain edges, such as the joint of two wall panels:
their matches have errors of 0.15 px across the edge and 2 to 10 px along it. Hundreds of such matches fit an essential
matrix of a wrong motion, with a sharp minimum.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

RADIUS_PX = 4.0
"""Half the side of the square at pyramid level 0: a FAST circle and the support of its gradients."""
MIN_WEAK_ROOT = 15.0
"""Minimum root of the tensor's smaller eigenvalue [grey levels]: with a difference of 15 grey levels between
corresponding pixels (noise, light, perspective), a patch is located to a pixel along its edge. The median error along
the edge is measured as 1.0 to 2.2 px below 12 and 0.4 to 1.1 px above 25."""

MIN_ROOT_RATIO = 0.1
"""Minimum root of the ratio of the eigenvalues: aliasing alone rotates the gradients of a straight, sharp edge by up to
5 degrees."""


def are_corners(grey: np.ndarray, uv: FloatArray, scale: FloatArray) -> NDArray[np.bool_]:
    """Mask ``(N,)`` of keypoints that are well localised in every direction.

    Args:
        grey: Image ``(H, W)`` uint8.
        uv: Pixels in it ``(N, 2)``.
        scale: Size of a pixel of their pyramid levels ``(N,)`` [px].

    Example:
        >>> panels = np.zeros((40, 40), np.uint8)
        >>> panels[:, 20:] = 200
        >>> panels[20:, 20:] = 100
        >>> are_corners(panels, np.array([[20.0, 10.0], [20.0, 20.0]]), np.ones(2)).tolist()
        [False, True]
    """
    if len(uv) == 0:
        return np.zeros(0, dtype=bool)
    xx, xy, yy = _tensor(grey, uv, RADIUS_PX * scale)
    mean, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    weak, strong = mean - spread, mean + spread
    corners: NDArray[np.bool_] = weak >= np.maximum((MIN_WEAK_ROOT * scale) ** 2, MIN_ROOT_RATIO**2 * strong)
    return corners


def _tensor(grey: np.ndarray, uv: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums of products of the gradient [grey levels per pixel] over squares around pixels, ``(N,)`` each."""
    height, width = grey.shape
    u, v = np.rint(uv).astype(np.int64).T
    r = np.rint(radius).astype(np.int64)
    left, right = np.clip(u - r, 0, width), np.clip(u + r + 1, 0, width)
    top, bottom = np.clip(v - r, 0, height), np.clip(v + r + 1, 0, height)
    gx, gy = (cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx, scale=0.125) for dx in (1, 0))

    def box(product: np.ndarray) -> FloatArray:
        total = cv2.integral(product, sdepth=cv2.CV_64F)
        out: FloatArray = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
        return out

    return box(gx * gx), box(gx * gy), box(gy * gy)
