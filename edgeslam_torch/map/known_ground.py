"""Whether the camera is back on ground that an earlier part of the map shows."""

import numpy as np
from scipy.sparse import csr_array

from edgeslam_torch.map.keyframe import Keyframe

MIN_SHARED = 15
"""Anchors in common from which on two keyframes are covisible, as in `SlamMap.covisible`."""


def is_back(earlier: list[Keyframe], recent: list[Keyframe]) -> bool:
    """Whether a recent keyframe sees what earlier ones had seen and what had been out of view since.

    Args:
        earlier: In the order of time.
        recent: Those that followed, in the order of time.
    """
    members = [*earlier, *recent]
    held = [k.anchor[k.anchor >= 0] for k in members]
    row = np.repeat(np.arange(len(members)), [len(h) for h in held])
    sees = csr_array((np.ones(len(row), np.int32), (row, np.concatenate(held))))
    covisible = (sees @ sees[: len(earlier)].T).toarray() >= MIN_SHARED
    later = np.arange(len(members))[:, None] > np.arange(len(earlier))
    lost = np.logical_or.accumulate(~covisible & later, axis=0)
    return bool((covisible & lost)[len(earlier) :].any())
