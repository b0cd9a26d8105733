"""Canny edges: OpenCV's for the CPU in real time, and a batched reference on kornia's gradient.

Both use the 3x3 Sobel gradient with the L2 norm, so that a kornia threshold ``t`` is OpenCV's ``255 t``; a test
compares them. kornia's own hysteresis iterates over pixels in Python (1.4 s per frame); connected components give the
same pixels in 3 ms.
"""

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

WELL_EXPOSED = 128.0
"""95 % quantile of a well exposed image [grey levels]: half of the range. Automatic exposure reaches 134 to 255 in
normal light, and only 30 to 50 in the dark."""
NOISE_GRADIENTS = 8.0
"""Noise of one grey level has a gradient (smoothed, 3x3 Sobel) of 1.3 on each axis and above 5.7 in one pixel of ten
thousand."""
_EVERY = 8
"""Subsampling along each axis for the exposure."""
_NOISE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
"""Zero on planes and straight edges; its response to unit noise has a standard deviation of 6 (Immerkaer 1996)."""


def canny(grey: NDArray[np.uint8], low: float, high: float) -> NDArray[np.bool_]:
    """Edge mask ``(H, W)`` of a grey image; thresholds in grey levels of the 3x3 Sobel gradient."""
    return canny_of_gradient(*gradient(grey), low, high)


def gradient(grey: NDArray[np.uint8]) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """3x3 Sobel gradient of the smoothed image along x and y, ``(H, W)`` each, as in `canny`."""
    gx, gy = cv2.spatialGradient(cv2.GaussianBlur(grey, (5, 5), 1.0), ksize=3, borderType=cv2.BORDER_REPLICATE)
    return gx.astype(np.int16, copy=False), gy.astype(np.int16, copy=False)


def canny_of_gradient(gx: NDArray[np.int16], gy: NDArray[np.int16], low: float, high: float) -> NDArray[np.bool_]:
    """`canny` from a given gradient."""
    return cv2.Canny(gx, gy, low, high, L2gradient=True).astype(bool)


def edge_thresholds(grey: NDArray[np.uint8], low: float, high: float) -> tuple[float, float]:
    """Canny's thresholds for an image ``(H, W)``: as given for a well exposed image, lower for a dark one.

    Gradients of the scene are proportional to the exposure, those of noise are not.

    Example:
        >>> import numpy as np
        >>> bright = np.tile(np.arange(0, 256, 2, dtype=np.uint8), (96, 1))
        >>> edge_thresholds(bright, 40.0, 100.0)
        (40.0, 100.0)
        >>> edge_thresholds(bright // 4, 40.0, 100.0)[1] < 60.0
        True
    """
    exposure = float(np.percentile(grey[::_EVERY, ::_EVERY], 95)) / WELL_EXPOSED
    if exposure >= 1.0:
        return low, high
    factor = min(1.0, max(exposure, NOISE_GRADIENTS * noise(grey) / high))
    return factor * low, factor * high


def noise(grey: NDArray[np.uint8]) -> float:
    """Standard deviation of the noise [grey levels], at least that of rounding; texture counts as noise, too."""
    response = cv2.filter2D(grey, cv2.CV_32F, _NOISE)[1:-1, 1:-1]
    return max(math.sqrt(math.pi / 2) * float(np.abs(response).mean()) / 6.0, 1.0 / math.sqrt(12.0))


def canny_batch(images: "Tensor", low: float, high: float) -> "Tensor":
    """Edge masks ``(B, H, W)`` bool of images ``(B, 1 or 3, H, W)`` in [0, 1]; the same thresholds as `canny`.

    Runs on the images' device; carries no gradient.
    """
    import torch
    from kornia.filters import Canny

    detector = Canny(low / 255.0, high / 255.0, hysteresis=False, kernel_size=(5, 5), sigma=(1.0, 1.0))
    with torch.no_grad():
        _, classes = detector(images)  # 0.5 weak, 1.0 strong
    strong = (classes[:, 0] > 0.75).cpu().numpy()
    candidate = (classes[:, 0] > 0.25).cpu().numpy()
    masks = np.stack([hysteresis(c, s) for c, s in zip(candidate, strong, strict=True)])
    return torch.from_numpy(masks).to(images.device)


def hysteresis(candidate: NDArray[np.bool_], strong: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Candidate pixels connected to a strong one (8-neighbourhood)."""
    count, labels = cv2.connectedComponents(candidate.astype(np.uint8), connectivity=8)
    keep = np.zeros(count, dtype=bool)
    keep[labels[strong & candidate]] = True
    keep[0] = False
    return keep[labels]
