"""Measured depth at some pixels and a network's own depth to dense depth.

The network provides shape, measurements provide distance. Their log ratio at the measured pixels, interpolated
smoothly, corrects the network's depth; far from measurements only the median ratio is applied.
"""

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray

SCALES = (0.15, 0.06, 0.025)
"""Standard deviations of the spreading, in image widths, coarse to fine."""
SHRINK = (0.3, 0.5, 1.0)
"""Prior weight at each scale, in points: finer corrections need more evidence."""
MAX_LOG_RATIO = 0.5
"""Points farther than this from the image's median ratio are occluded or wrong."""


def densify(log_depth: FloatArray, uv: FloatArray, log_z: FloatArray) -> FloatArray:
    """Log depth ``(H, W)`` corrected to pass near map points at pixels ``(N, 2)`` with log depths ``(N,)``."""
    height, width = log_depth.shape
    v = np.clip(np.rint(uv[:, 1]), 0, height - 1).astype(int)
    u = np.clip(np.rint(uv[:, 0]), 0, width - 1).astype(int)
    ratio = log_z - log_depth[v, u]
    median = float(np.median(ratio))
    kept = np.abs(ratio - median) < MAX_LOG_RATIO
    v, u, ratio = v[kept], u[kept], ratio[kept]
    correction = np.full((height, width), median, np.float32)
    count = np.zeros((height, width), np.float32)
    np.add.at(count, (v, u), 1.0)
    for scale, doubt in zip(SCALES, SHRINK, strict=True):
        sigma = scale * width
        rest = np.zeros((height, width), np.float32)
        np.add.at(rest, (v, u), ratio - correction[v, u])
        # A point's share in the middle of its own Gaussian is 1 / (2 pi sigma^2): uncertainty in points.
        weight = cv2.GaussianBlur(count, (0, 0), sigma) + doubt / (2 * np.pi * sigma**2)
        correction = correction + cv2.GaussianBlur(rest, (0, 0), sigma) / weight
    return log_depth + correction
