"""Images that repeat the one before them: a camera that hangs, a stuck encoder, a frame rate made higher by copies."""

import numpy as np
from numpy.typing import NDArray

REPEATED = "the image repeats the one before"
"""Reason of such a frame."""

_GRID = 4
"""Every fourth pixel of every fourth row is compared: 30 us a frame of 640x480."""
_LEAST_CHANGE = 0.3
"""Mean absolute difference [grey levels] from which on two images differ. Noise of one level alone makes 1.1, and over
nine recordings, slow ones and bare walls among them, 0.99 is the least. A still picture that went through an MPEG-4
encoder is never the same to the bit, but within 0.26, save for a key picture now and then."""
_LONG_S = 0.3
"""A stretch of so long is no copy made for the frame rate: 5 images a second shown at 30 repeat for 0.17 s."""


class RepeatedImages:
    """Recognises images without news; one instance follows one stream."""

    def __init__(self) -> None:
        self._reference: NDArray[np.int16] | None = None
        """The present stretch's first image: against it a slow motion adds up."""
        self._since_s = 0.0
        self._long: dict[float, float] = {}
        """First stamp to last of the long stretches."""

    def repeats(self, grey: NDArray[np.uint8], stamp_s: float) -> bool:
        """Whether an image ``(H, W)`` shows what the images since some earlier one have shown."""
        grid = grey[::_GRID, ::_GRID].astype(np.int16)
        if self._reference is None or _change(self._reference, grid) >= _LEAST_CHANGE:
            self._reference, self._since_s = grid, stamp_s
            return False
        if stamp_s - self._since_s >= _LONG_S:
            self._long[self._since_s] = stamp_s
        return True

    def warning(self) -> str | None:
        """The long stretches in a sentence; None without any."""
        if not self._long:
            return None
        first, last = max(self._long.items(), key=lambda stretch: stretch[1] - stretch[0])
        times = "" if len(self._long) == 1 else f" {len(self._long)} times, the longest"
        return (
            f"the video stood still{times} from {first:.1f} to {last:.1f} s, the same image again and again: "
            "where the camera moved meanwhile is not known"
        )


def _change(before: NDArray[np.int16], now: NDArray[np.int16]) -> float:
    return float(np.abs(now - before).mean()) if before.shape == now.shape else np.inf
