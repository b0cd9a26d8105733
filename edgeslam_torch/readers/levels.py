"""Pictures of more than eight bits (thermal cameras, 10, 12 or 14 bits in 16, floats) as eight bits."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIRST = 10
"""Pictures at the start of a recording that decide."""
_OUTLIERS_PERCENT = 0.1
"""Percentage of pixels ignored at either end: hot and dead pixels."""
_SAMPLES = 65536
"""Maximum number of sampled pixels of an image."""
_NARROW = 0.25
"""Values that fill less than this share of their bits lie far from zero, as a thermal camera's do."""
_MARGIN = 0.25
"""Room on either side for what the first pictures do not show, as a share of their range."""


@dataclass(frozen=True, slots=True)
class Levels:
    """Values that become black and white; the same for all pictures of a recording, so that brightness is constant."""

    black: float
    white: float
    words: str
    """Description of the conversion for the user."""

    def eight_bits(self, picture: NDArray[Any]) -> NDArray[np.uint8]:
        """The picture in 0 to 255; one of eight bits as it is."""
        if picture.dtype == np.uint8:
            return np.asarray(picture)
        scaled = (picture.astype(np.float32) - self.black) * (256.0 / (self.white - self.black))
        return np.nan_to_num(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)


def levels_of(pictures: Iterable[NDArray[Any]]) -> Levels:
    """Levels by a recording's first pictures.

    Where the values fill their bits, the highest eight of the bits in use are kept; where they lie in a narrow range,
    the range is stretched. Floating point that fills [0, 1] is that range.
    """
    pictures = list(pictures)
    values = np.concatenate([_sampled(picture) for picture in pictures])
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, [_OUTLIERS_PERCENT, 100.0 - _OUTLIERS_PERCENT]) if len(values) else (0.0, 0.0)
    bits = max(8, int(min(high, 2.0**62)).bit_length()) if high > low else 16
    if low >= 0.0 and (high == low or (high >= 2.0 and high - low >= _NARROW * 2**bits)):
        return Levels(0.0, float(2**bits), f"{bits} bits in use, of which the highest eight are kept")
    if pictures[0].dtype.kind == "f" and low >= 0.0 and high - low >= _NARROW and high <= 1.0:
        return Levels(0.0, 1.0, "floating point in [0, 1], which becomes black to white")
    margin = _MARGIN * max(high - low, 1e-6)
    words = f"values {low:.6g} to {high:.6g} in the first pictures; these and a quarter more become black to white"
    return Levels(float(low - margin), float(high + margin), words)


def _sampled(picture: NDArray[Any]) -> NDArray[np.float64]:
    step = max(1, round((picture.size / _SAMPLES) ** 0.5))
    return picture[::step, ::step].ravel().astype(np.float64)
