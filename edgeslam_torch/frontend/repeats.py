"""Images that repeat the previous one: a frozen camera, a stuck encoder, or a frame rate raised by copies."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

REPEATED = "the image repeats the one before"
"""Reason in the frame's status."""

_GRID = 4
"""Every fourth pixel of every fourth row is compared: 30 us per frame of 640x480."""
_MIN_CHANGE = 0.3
"""Mean absolute difference [grey levels] above which two images differ. Sensor noise of one level gives 1.1, slow
motion past bare walls 0.99. A static scene through an MPEG-4 encoder stays within 0.26, except for key frames."""
_LONG_S = 0.3
"""Longer repeats are not copies for the frame rate: 5 images per second played at 30 repeat for 0.17 s."""


class RepeatedImages:
    """Detects repeated images; one instance per stream."""

    def __init__(self) -> None:
        self._reference: NDArray[np.int16] | None = None
        """First image of the current stretch, against which slow motion accumulates."""
        self._since_s, self._began_s = 0.0, math.inf
        self._long: dict[float, float] = {}
        """First to last stamp of long stretches."""

    def repeats(self, grey: NDArray[np.uint8], stamp_s: float) -> bool:
        """Whether an image ``(H, W)`` repeats the current stretch."""
        grid, self._began_s = grey[::_GRID, ::_GRID].astype(np.int16), min(self._began_s, stamp_s)
        if self._reference is None or _change(self._reference, grid) >= _MIN_CHANGE:
            self._reference, self._since_s = grid, stamp_s
            return False
        if stamp_s - self._since_s >= _LONG_S:
            self._long[self._since_s] = stamp_s
        return True

    def warning(self, hovers: Callable[[float, float], bool] = lambda from_s, to_s: False) -> str | None:
        """Warning about long stretches in which the camera did not hover; None without any."""
        stretches = [stretch for stretch in self._long.items() if not hovers(*stretch)]
        if not stretches:
            return None
        first, last = (s - self._began_s for s in max(stretches, key=lambda stretch: stretch[1] - stretch[0]))
        times = "" if len(stretches) == 1 else f" {len(stretches)} times, the longest"
        return (
            f"the video froze{times} from {first:.1f} to {last:.1f} s after the first frame, the same image "
            "repeated: where the camera moved meanwhile is not known"
        )


def _change(before: NDArray[np.int16], now: NDArray[np.int16]) -> float:
    return float(np.abs(now - before).mean()) if before.shape == now.shape else np.inf
