"""Rescaling of distances stored with anchors and keyframes after a refinement changed the local scale.

A window changes the scale by too little to matter. Telemetry that corrects a drift changes it by half and more:
anchors would be looked for on the wrong pyramid level, and priors would pull back.
"""

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FloatArray, IntArray

MIN_ANCHORS = 8
"""Minimum number of anchors of a keyframe for its change of scale."""

Depths = dict[int, tuple[IntArray, FloatArray]]
"""Anchors that each keyframe sees, by its id, and their depths in it."""


def depths(slam_map: SlamMap, keyframes: list[Keyframe]) -> Depths:
    """Present depths of the anchors in keyframes."""
    seen = {}
    for keyframe in keyframes:
        observed = keyframe.anchor[keyframe.anchor >= 0]
        seen[keyframe.id] = observed, se3.transform(keyframe.T_c_w, slam_map.anchors.p_w[observed])[:, 2]
    return seen


def take_along(slam_map: SlamMap, keyframes: list[Keyframe], before: Depths) -> None:
    """Scale stored distances by the change of each keyframe's anchor depths since ``before``.

    Args:
        slam_map: After the refinement.
        keyframes: Refined ones, in the order of time: an anchor is scaled by its last observer.
        before: Their `depths` before it.
    """
    anchors = slam_map.anchors
    grown = np.ones(len(anchors.alive))
    with slam_map.lock:
        for keyframe in keyframes:
            observed, z = before[keyframe.id]
            now = se3.transform(keyframe.T_c_w, anchors.p_w[observed])[:, 2]
            good = anchors.alive[observed] & (z > 0) & (now > 0)
            if good.sum() < MIN_ANCHORS:
                continue
            growth = float(np.exp(np.median(np.log(now[good] / z[good]))))
            grown[observed] = growth
            keyframe.scale(growth)
            hosted = np.flatnonzero(anchors.alive & anchors.from_depth & (anchors.host == keyframe.id))
            anchors.prior[hosted] /= growth
            anchors.origin[hosted] = keyframe.centre_w
        anchors.max_distance *= grown
        anchors.sigma *= grown
