"""Edge pixels of a keyframe with their normals and colours."""

import cv2
import numpy as np

from edgeslam_torch.frontend.canny import canny_of_gradient, edge_thresholds, gradient
from edgeslam_torch.frontend.image import as_grey, colours_at
from edgeslam_torch.types import Edges, FloatArray


def extract_edges(image: np.ndarray, low: float, high: float, most: int, border_px: int = 6) -> Edges:
    """Canny edges of an undistorted image ``(H, W, 3)`` BGR or ``(H, W)`` grey.

    Args:
        image: Undistorted image.
        low: Lower hysteresis threshold of a well exposed image [grey levels].
        high: Upper hysteresis threshold.
        most: Maximum number of edge pixels; thinned evenly along the edges.
        border_px: Margin without edges, where gradients and warped patches leave the image.
    """
    grey = as_grey(image)
    along_x, along_y = gradient(grey)
    mask = canny_of_gradient(along_x, along_y, *edge_thresholds(grey, low, high))
    mask[:border_px] = mask[-border_px:] = False
    mask[:, :border_px] = mask[:, -border_px:] = False
    at = cv2.findNonZero(mask.view(np.uint8))  # same order as np.nonzero, five times as fast
    u, v = np.zeros((2, 0), np.int32) if at is None else at.reshape(-1, 2).T
    if len(u) > most:
        # Every n-th pixel of a diagonal sweep: neighbours on an edge differ in u + v, so edges thin evenly.
        key = (u + v) % max(2, int(np.ceil(len(u) / most))) * 2 + (u % 2)
        order = np.argsort(key.astype(np.uint16), kind="stable")[:most]  # radix sort for 16-bit keys
        order.sort()
        u, v = u[order], v[order]
    gx, gy = along_x[v, u].astype(np.float32), along_y[v, u].astype(np.float32)
    norm = np.maximum(np.hypot(gx, gy), 1e-6)
    normal: FloatArray = np.stack([gx / norm, gy / norm], axis=1).astype(np.float32)
    uv: FloatArray = np.stack([u, v], axis=1).astype(np.float32)
    return Edges(uv, normal, colours_at(image, uv))
