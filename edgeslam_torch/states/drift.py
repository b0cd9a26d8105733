"""Drift of the map, from the length of its shortest covisibility path.

Keyframes with common anchors constrain each other; along a chain of them position and scale drift. The drift at a
keyframe therefore grows with the shortest path to it from the first keyframe over covisible keyframes: a revisit
makes the path short again.
"""

from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap

SHARE = 0.02
"""Standard deviation of the drift per axis, as a share of the path length; empirical."""
_NEIGHBOURS = 10
"""Covisible keyframes through which a new one can be reached."""


@dataclass(slots=True)
class Drift:
    """Path length [map units] from the first keyframe to each of the others, by their ids."""

    way: dict[int, float] = field(default_factory=dict)
    newest: float = 0.0
    """Path length of the newest keyframe."""

    def add(self, slam_map: SlamMap, keyframe: Keyframe) -> None:
        """Add a mapped keyframe."""
        near = [k for k in slam_map.covisible(keyframe, _NEIGHBOURS) if k.id in self.way]
        ways = [self.way[k.id] + float(np.linalg.norm(k.centre_w - keyframe.centre_w)) for k in near]
        self.newest = self.way[keyframe.id] = min(ways, default=self.newest)
