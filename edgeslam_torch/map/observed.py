"""Observations of anchors by keyframes, for the writers."""

import numpy as np

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import Observations


def observations(keyframes: list[Keyframe], slam_map: SlamMap) -> Observations:
    """Observations by ``keyframes`` of the anchors of `Anchors.cloud`; the caller holds the map's lock."""
    shown = slam_map.anchors.confirmed(slam_map.anchors_seen_by(keyframes))
    row = np.full(len(slam_map.anchors.alive), -1)
    row[shown] = np.arange(len(shown))
    keypoints = [k[row[keyframe.anchor[k]] >= 0] for keyframe in keyframes for k in [keyframe.keypoints_with_anchor()]]
    pairs = list(zip(keyframes, keypoints, strict=True))
    return Observations(
        np.array([keyframe.stamp_s for keyframe in keyframes], dtype=np.float64),
        np.repeat(np.arange(len(keyframes)), [len(k) for k in keypoints]),
        np.concatenate([np.zeros(0, np.int64), *(row[keyframe.anchor[k]] for keyframe, k in pairs)]),
        np.concatenate([np.zeros((0, 2), np.float32), *(keyframe.features.uv[k] for keyframe, k in pairs)]),
    )
