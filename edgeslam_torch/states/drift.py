"""How far a map may have drifted from where it began: by the way along which it was made.

What two keyframes both see holds them to each other; from one to the next a map bends and changes its scale by a
little. So the shortest way counts that leads from the first keyframe to the present one over keyframes with anchors in
common: where the camera has come back to what it knows, it is short again.
"""

from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap

SHARE = 0.02
"""Standard deviation per axis of what a map drifts by, as a share of the way."""
_NEIGHBOURS = 10
"""Keyframes that a new one shares most anchors with, which are asked for the way to them."""


@dataclass(slots=True)
class Drift:
    """The way [map units] from the flight's first keyframe to each of the others, by their ids."""

    way: dict[int, float] = field(default_factory=dict)
    newest: float = 0.0
    """That of the newest keyframe."""

    def add(self, slam_map: SlamMap, keyframe: Keyframe) -> None:
        """A keyframe has been mapped."""
        near = [k for k in slam_map.covisible(keyframe, _NEIGHBOURS) if k.id in self.way]
        ways = [self.way[k.id] + float(np.linalg.norm(k.centre_w - keyframe.centre_w)) for k in near]
        self.newest = self.way[keyframe.id] = min(ways, default=self.newest)
