"""What a flight makes of the map of earlier flights: when it was found again, and how much was flown in it."""

import math
from dataclasses import dataclass
from typing import Any

from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import Support

FOUND = "placed in the map of an earlier flight"
"""Reason of the first such frame, in words."""


@dataclass(slots=True)
class PriorMaps:
    """The atlas that a flight began with."""

    flights: tuple[str, ...]
    """Their names, oldest first."""
    keyframes: int
    """That were loaded."""
    pieces: int
    """Pieces 0 to ``pieces`` - 1 are theirs."""
    begin_s: float = math.inf
    """Stamp of this flight's first frame."""
    found_s: float = math.inf
    """Stamp of the first frame that was placed in their map while flying."""

    def see(self, stamp_s: float, piece: int, supported: bool) -> str:
        """Take note of a frame's piece; what is to be said of it in ``status.csv``, mostly nothing."""
        self.begin_s = min(self.begin_s, stamp_s)
        if not supported or piece >= self.pieces or math.isfinite(self.found_s):
            return ""
        self.found_s = stamp_s
        return FOUND

    def placed(self, support: Support) -> int:
        """Frames that the map of earlier flights, with what was added to it, supports."""
        return int((support.supported & (support.piece < self.pieces)).sum())

    def summary(self, support: Support, slam_map: SlamMap) -> dict[str, Any]:
        """For ``summary.json``."""
        inside = [k for k in slam_map.keyframes.values() if slam_map.piece_of(k.id) < self.pieces]
        return {
            "flights": list(self.flights),
            "keyframes": self.keyframes,
            "found_after_s": self.found_s - self.begin_s if math.isfinite(self.found_s) else None,
            "frames_placed": self.placed(support),
            "keyframes_added": sum(math.isfinite(k.stamp_s) for k in inside),
        }

    def warning(self, support: Support) -> str | None:
        """Said when this flight's map and the loaded one stay apart."""
        if self.placed(support) > 0:
            return None
        return "no place of the atlas was recognised: this flight's map and poses do not relate to it"
