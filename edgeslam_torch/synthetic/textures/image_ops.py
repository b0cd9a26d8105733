"""Arithmetic on 8-bit images that gives the same bytes on every processor.

OpenCV rounds products, resized and warped images of 8 bits otherwise on Arm than on x86. A flight that is drawn again
on another processor must show the same pictures, so what decides about their bytes is done where rounding is defined.
"""

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray

TIE = 1e-6
"""Sums of doubles in another order differ by far less, and means of few 8-bit numbers that are not ties by far more."""


def product(image: np.ndarray, gain: FloatArray) -> np.ndarray:
    """``image * gain`` to the nearest grey level, ``(H, W)`` or ``(H, W, C)`` uint8 both ways.

    One product of float32 each, which IEEE 754 defines to the last bit.

    >>> product(np.array([[200, 10]], np.uint8), np.array([[0.5, 30.0]], np.float32)).tolist()
    [[100, 255]]
    """
    return cv2.multiply(image, np.asarray(gain, np.float32), dtype=cv2.CV_8U)


def shrunk(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mean of the area under each new pixel, halves up, uint8.

    >>> shrunk(np.array([[10, 11], [10, 11]], np.uint8), 1, 1).tolist()
    [[11]]
    """
    mean = cv2.resize(image.astype(np.float64), (width, height), interpolation=cv2.INTER_AREA)
    return np.floor(mean + (0.5 + TIE)).astype(np.uint8)


def resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bilinear interpolation in whole numbers, uint8.

    >>> resized(np.array([[0, 100]], np.uint8), 4, 1).tolist()
    [[0, 25, 75, 100]]
    """
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR_EXACT))


def looked_up(image: np.ndarray, x_px: FloatArray, y_px: FloatArray) -> np.ndarray:
    """Bilinear interpolation at pixels, ``(H, W)`` each, in steps of 1/256 px; the border goes on outside.

    Grey levels of 8 bits times two weights of 8 bits are exact in float32, and so is their sum, in any order.

    >>> looked_up(np.array([[0, 100]], np.uint8), np.array([[0.25, 3.0]]), np.zeros((1, 2))).tolist()
    [[25, 100]]
    """
    x, y = (np.rint(256.0 * np.asarray(v)).astype(np.float32) / np.float32(256.0) for v in (x_px, y_px))
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
