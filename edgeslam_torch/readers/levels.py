"""Pictures of more than eight bits (thermal cameras, 10, 12 or 14 bits in 16, floats) as eight bits."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

FIRST = 10
"""Pictures with contrast at the start of a recording that decide."""
_LOOKED_AT = 300
"""Maximum number of pictures looked at for these."""
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
    the range is stretched. Floating point that fills [0, 1] is that range. A picture without contrast, such as a closed
    shutter's, decides nothing, nor does one whose values are all beyond the usual range.

    Args:
        pictures: ``(H, W)`` or ``(H, W, C)``, at least one; taken until `FIRST` have contrast.
    """
    first, *others = islice(_with_contrast(pictures), 1 + FIRST)
    is_float = first.dtype.kind == "f"
    sampled = [_sampled(picture) for picture in others or [first]]
    ranges = np.array([_range(values) for values in sampled])
    darkest, brightest = np.median(ranges, axis=0)
    usual = (ranges[:, 0] <= brightest) & (ranges[:, 1] >= darkest)
    low, high = _range(np.concatenate([sampled[i] for i in np.flatnonzero(usual)]))
    bits = max(8, int(min(high, 2.0**62)).bit_length()) if high > low else 16
    if low >= 0.0 and (high == low or (high >= 2.0 and high - low >= _NARROW * 2**bits)):
        return Levels(0.0, float(2**bits), f"{bits} bits in use, of which the highest eight are kept")
    if is_float and low >= 0.0 and high - low >= _NARROW and high <= 1.0:
        return Levels(0.0, 1.0, "floating point in [0, 1], which becomes black to white")
    margin = _MARGIN * max(high - low, 1e-6)
    words = f"values {low:.6g} to {high:.6g} in the first pictures; these and a quarter more become black to white"
    return Levels(float(low - margin), float(high + margin), words)


def _with_contrast(pictures: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The first picture, and all that have contrast."""
    for i, picture in enumerate(islice(pictures, _LOOKED_AT)):
        if i == 0:
            yield picture
        low, high = _range(_sampled(picture))
        if low < high:
            yield picture


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    """Lowest and highest value, without outliers."""
    if not len(values):
        return 0.0, 0.0
    low, high = np.percentile(values, [_OUTLIERS_PERCENT, 100.0 - _OUTLIERS_PERCENT])
    return float(low), float(high)


def _sampled(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Finite values of some of the pixels."""
    step = max(1, round((picture.size / _SAMPLES) ** 0.5))
    values = picture[::step, ::step].ravel().astype(np.float64)
    return values[np.isfinite(values)]
