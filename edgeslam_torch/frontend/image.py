"""Conversions of raw images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray


def as_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(H, W)`` of a BGR or grey image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def colours_at(image: NDArray[np.uint8] | None, uv: FloatArray) -> NDArray[np.uint8]:
    """RGB at the nearest pixels of ``(N, 2)``, shape ``(N, 3)``; black without an image."""
    if image is None:
        return np.zeros((len(uv), 3), dtype=np.uint8)
    u = np.clip(np.rint(uv[:, 0]), 0, image.shape[1] - 1).astype(np.int64)
    v = np.clip(np.rint(uv[:, 1]), 0, image.shape[0] - 1).astype(np.int64)
    colour = image[v, u]
    return np.repeat(colour[:, None], 3, axis=1) if image.ndim == 2 else colour[:, ::-1]
