"""Use of the map of earlier flights: when it was recognised, and how many frames it supports."""

import math
from dataclasses import dataclass
from typing import Any

from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import Support

FOUND = "localised in the map of an earlier flight"
"""Reason of the first such frame."""


@dataclass(slots=True)
class PriorMaps:
    """The atlas that a flight began with."""

    flights: tuple[str, ...] = ()
    """Their names, oldest first."""
    keyframes: int = 0
    """Number of loaded keyframes."""
    pieces: int = 0
    """Number of loaded submaps, 0 to ``pieces`` - 1; none without an atlas."""
    begin_s: float = math.inf
    """Stamp of this flight's first frame."""
    found_s: float = math.inf
    """Stamp of the first frame that was localised in them."""

    def see(self, stamp_s: float, piece: int, supported: bool) -> str:
        """Record a frame's submap; returns a note for ``status.csv``, mostly empty."""
        self.begin_s = min(self.begin_s, stamp_s)
        if not supported or piece >= self.pieces or math.isfinite(self.found_s):
            return ""
        self.found_s = stamp_s
        return FOUND

    def placed(self, support: Support) -> int:
        """Number of frames supported by submaps of earlier flights, including later additions."""
        return int((support.supported & (support.piece < self.pieces)).sum())

    def summary(self, support: Support, slam_map: SlamMap) -> dict[str, Any] | None:
        """For ``summary.json``; None without an atlas."""
        if not self.pieces:
            return None
        inside = [k for k in slam_map.keyframes.values() if slam_map.piece_of(k.id) < self.pieces]
        return {
            "flights": list(self.flights),
            "keyframes": self.keyframes,
            "found_after_s": self.found_s - self.begin_s if math.isfinite(self.found_s) else None,
            "frames_placed": self.placed(support),
            "keyframes_added": sum(math.isfinite(k.stamp_s) for k in inside),
        }

    def warning(self, support: Support) -> str | None:
        """Warning if this flight's map was not merged with the loaded one."""
        if not self.pieces or self.placed(support) > 0:
            return None
        return "no place of the atlas was recognised: this flight's map and poses do not relate to it"
