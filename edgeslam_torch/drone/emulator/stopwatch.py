"""A stopwatch in the corner of the picture, as filming a clock measures the delay of a real drone's video.

Sixteen squares hold the milliseconds modulo 65.536 s, white for one, most significant first; below each is its
complement, so that other content is not mistaken for a time.
"""

import numpy as np

_BITS = 16
PERIOD_S = 2**_BITS / 1e3
_SHARE = 40
"""Side of a square relative to the picture's width."""


def draw_time(image: np.ndarray, time_s: float) -> None:
    """Write a time into the lower left corner of a picture ``(H, W, 3)``, in place."""
    side = image.shape[1] // _SHARE
    bits = _bits(int(round(1e3 * time_s)) % 2**_BITS)
    rows = 255 * np.stack([bits, 1 - bits]).astype(np.uint8)  # (2, 16)
    patch = np.kron(rows, np.ones((side, side), np.uint8))
    image[-2 * side :, : _BITS * side] = patch[:, :, None]


def read_time(image: np.ndarray) -> float | None:
    """Time [s] modulo `PERIOD_S` that a picture ``(H, W, 3)`` shows; None when it shows none."""
    side = image.shape[1] // _SHARE
    if side < 2 or image.shape[0] < 2 * side:
        return None
    patch = image[-2 * side :, : _BITS * side, 1].reshape(2, side, _BITS, side)
    middle = slice(side // 4, side - side // 4)
    level = patch[:, middle, :, middle].mean(axis=(1, 3))  # (2, 16)
    if np.abs(level[0] - level[1]).min() < 80.0:
        return None
    weights = 1 << np.arange(_BITS - 1, -1, -1)
    return float(np.sum((level[0] > level[1]) * weights)) / 1e3


def age_s(shown_s: float, now_s: float) -> float:
    """Time [s] from the shown time to ``now_s`` on the same clock, modulo `PERIOD_S`."""
    return (now_s - shown_s) % PERIOD_S


def _bits(number: int) -> np.ndarray:
    return (number >> np.arange(_BITS - 1, -1, -1)) & 1
