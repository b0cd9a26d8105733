"""The input of a depth network: a resized, normalised image."""

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.layout import INPUT_MULTIPLE
from edgeslam_torch.types import FloatArray


class Normalisation(Protocol):
    """Input is ``(rgb - mean) / std`` with rgb in [0, 1]."""

    @property
    def mean(self) -> tuple[float, float, float]:
        """Of red, green and blue."""

    @property
    def std(self) -> tuple[float, float, float]:
        """Of red, green and blue."""


def check_image(image: NDArray[np.uint8], camera: Camera) -> None:
    """Reject an image that does not match the camera.

    Raises:
        ValueError: If its size differs or it has neither one nor three channels.
    """
    if image.shape[:2] != (camera.height, camera.width) or image.ndim not in (2, 3):
        raise ValueError(f"image {image.shape} does not fit a camera of {camera.width}x{camera.height}")


def preprocess(image: NDArray[np.uint8], height: int, width: int, values: Normalisation) -> FloatArray:
    """BGR or grey uint8 -> ``(1, 3, height, width)`` float32 normalised RGB, resized without cropping."""
    shrinks = height <= image.shape[0] and width <= image.shape[1]
    if shrinks:
        # In floats: the rounding of half grey levels differs between x86 and Arm.
        small = cv2.resize(image.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    else:
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    gain = np.float32(1.0) / (np.float32(255.0) * np.array(values.std, np.float32))
    offset = np.array(values.mean, np.float32) / np.array(values.std, np.float32)
    planes = np.empty((1, 3, height, width), np.float32)
    for i, plane in enumerate(planes[0]):
        np.multiply(small if small.ndim == 2 else small[:, :, 2 - i], gain[i], out=plane)
        plane -= offset[i]
    return planes


def network_size(height: int, width: int, training: tuple[int, int], multiple: int = INPUT_MULTIPLE) -> tuple[int, int]:
    """Input size ``(height, width)``: multiples close to the image's shape, of at most the area of training's size."""
    area = training[0] * training[1]
    best, best_cost = training, np.inf
    for h in range(multiple, 2 * training[0] + 1, multiple):
        for w in range(multiple, 2 * training[1] + 1, multiple):
            if h * w > area:
                continue
            # A 10 % change of aspect ratio counts as much as losing 20 % of the pixels.
            cost = abs(np.log((w / h) / (width / height))) + 0.5 * np.log(area / (h * w))
            if cost < best_cost - 1e-9:
                best, best_cost = (h, w), cost
    return best
