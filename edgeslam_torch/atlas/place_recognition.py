"""Place recognition: keypoints of an image vote for keyframes through similar anchors.

A vote costs one pass over the descriptors of the map (256 bits each, 200 keypoints against 10 000 anchors: 12 ms on one
core). It needs no vocabulary and has no state, so it is always consistent with the map.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import IntArray

MOST_VOTERS = 200
MAX_HAMMING = 50
"""Bits, of 256; the strict threshold of ORB-SLAM2, since a vote has no geometric check."""
RATIO = 0.9
"""Maximum ratio of the nearest to the second nearest distance."""
MIN_VOTES = 8
"""Votes above which a keyframe becomes a revisit candidate: places in other rooms get at most 4."""


def revisit_candidates(
    slam_map: SlamMap, words: NDArray[np.uint64], among: list[Keyframe], most: int, min_votes: int = MIN_VOTES
) -> list[Keyframe]:
    """Keyframes that observe most of the anchors similar to an image's keypoints, best first.

    Args:
        slam_map: Holds the anchors.
        words: Descriptors of the image ``(N, 4)``.
        among: Keyframes to choose from.
        most: Maximum number of results.
        min_votes: Minimum number, of `MOST_VOTERS` or fewer.
    """
    votes = votes_for(slam_map, words, slam_map.anchors_seen_by(among))
    allowed = {keyframe.id for keyframe in among}
    counts = {id: n for id, n in slam_map.shared_counts(votes).items() if id in allowed and n >= min_votes}
    ranked = sorted(counts, key=lambda id: (-counts[id], -id))
    return [slam_map.keyframes[id] for id in ranked[:most]]


def votes_for(slam_map: SlamMap, words: NDArray[np.uint64], anchors: IntArray) -> IntArray:
    """Those of the anchors ``(A,)`` that match keypoints of an image, each once."""
    voters = words[:: 1 + (len(words) - 1) // MOST_VOTERS] if len(words) else words
    if len(voters) == 0 or len(anchors) < 2:
        return anchors[:0]
    known = np.ascontiguousarray(slam_map.anchors.words[anchors]).view(np.uint8)
    distance, nearest = cv2.batchDistance(
        np.ascontiguousarray(voters).view(np.uint8), known, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )
    good = (distance[:, 0] <= MAX_HAMMING) & (distance[:, 0] <= RATIO * distance[:, 1])
    return np.unique(anchors[nearest[good, 0]])
