"""Detection of revisits: the camera is back at a place of an earlier part of the map."""

import numpy as np

from edgeslam_torch.compiled import compiled
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.types import FloatArray, IntArray

MIN_SHARED = 15
"""Anchors in common from which on two keyframes are covisible, as in `SlamMap.covisible`."""
OUT_OF_VIEW = 5
"""Common anchors below which two keyframes show different places; along a straight path their number decreases and
fluctuates around `MIN_SHARED`."""


def is_back(earlier: list[Keyframe], recent: list[Keyframe], reach: FloatArray) -> bool:
    """Whether a recent keyframe shares anchors with an earlier one that was out of view in between.

    Args:
        earlier: In the order of time.
        recent: Those that followed, in the order of time.
        reach: Distance from each of both ``(K,)`` [map units] within which the camera only rotated.
    """
    members = [*earlier, *recent]
    shared = _shared(members, len(earlier))
    number = np.arange(len(members))
    covisible = (shared >= MIN_SHARED) & (number[:, None] >= number[: len(earlier)])
    last = np.maximum.accumulate(np.where(covisible, number[:, None], -1), axis=0)
    centre = np.stack([k.centre_w for k in members])
    away = np.linalg.norm(centre[:, None] - centre, axis=2) > reach[:, None]
    back = np.zeros_like(covisible)
    for before, place in np.argwhere(covisible[1:] & ~covisible[:-1] & (last[:-1] >= 0)).tolist():
        gap = slice(last[before, place] + 1, before + 1)
        back[before + 1, place] = bool(np.any((shared[gap, place] < OUT_OF_VIEW) & away[before + 1, gap]))
    known = np.logical_or.accumulate(back, axis=0)
    return bool((covisible & known)[len(earlier) :].any())


def _shared(members: list[Keyframe], earlier: int) -> IntArray:
    """Number of common anchors of keyframes with each of the first ones of them, ``(K, E)``."""
    observed = [k.anchor[k.anchor >= 0] for k in members]
    first = np.cumsum([0, *(len(anchor) for anchor in observed)])
    return _counted(np.concatenate(observed), first, earlier)


@compiled("i8[::1], i8[::1], i8")
def _counted(anchor: IntArray, first: IntArray, earlier: int) -> IntArray:
    """Common anchors ``(K, E)`` of keyframes whose anchors follow each other, from ``first`` ``(K + 1,)`` on."""
    seen = np.zeros(anchor.max() + 2 if len(anchor) else 1, np.int64)  # where the keyframes that see an anchor begin
    for k in range(first[earlier]):
        seen[anchor[k] + 1] += 1
    seen = np.cumsum(seen)
    keyframe, end = np.empty(first[earlier], np.int64), seen.copy()
    for row in range(earlier):
        for k in range(first[row], first[row + 1]):
            keyframe[end[anchor[k]]] = row
            end[anchor[k]] += 1
    shared = np.zeros((len(first) - 1, earlier), np.int64)
    for row in range(len(first) - 1):
        for k in range(first[row], first[row + 1]):
            for m in range(seen[anchor[k]], seen[anchor[k] + 1]):
                shared[row, keyframe[m]] += 1
    return shared
