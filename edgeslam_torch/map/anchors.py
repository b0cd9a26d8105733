"""Triangulated anchors as a structure of arrays; an anchor's id is its row."""

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray, IntArray, PointCloud

MIN_OBSERVATIONS = 2
"""Keyframes that must observe an anchor for it to be given out: the first one alone has not been confirmed."""


class Anchors:
    """All anchors of the map. Rows of removed anchors are reused after the next `begin_pass`."""

    def __init__(self, capacity: int = 4096) -> None:
        self.p_w: FloatArray = np.zeros((capacity, 3))
        self.words: NDArray[np.uint64] = np.zeros((capacity, 4), dtype=np.uint64)
        self.normal: FloatArray = np.zeros((capacity, 3))
        """Mean direction from the observing cameras to the anchor."""
        self.max_distance: FloatArray = np.zeros(capacity)
        """Distance at which the anchor would be seen at pyramid level 0."""
        self.colour: NDArray[np.uint8] = np.zeros((capacity, 3), dtype=np.uint8)
        self.observations: IntArray = np.zeros(capacity, dtype=np.int64)
        """Number of keyframes that observe the anchor."""
        self.visible: IntArray = np.zeros(capacity, dtype=np.int64)
        self.found: IntArray = np.zeros(capacity, dtype=np.int64)
        """Frames in which it was predicted and found, respectively."""
        self.born: IntArray = np.zeros(capacity, dtype=np.int64)
        """Keyframe id of creation."""
        self.alive: NDArray[np.bool_] = np.zeros(capacity, dtype=bool)
        self.from_depth: NDArray[np.bool_] = np.zeros(capacity, dtype=bool)
        """Whether the depth comes from a prior instead of parallax; see `host`, `prior` and `origin`."""
        self.host: IntArray = np.full(capacity, -1, dtype=np.int64)
        """Id of the host keyframe of the prior."""
        self.origin: FloatArray = np.zeros((capacity, 3))
        """Camera centre of the host at creation [map units]."""
        self.prior: FloatArray = np.zeros((capacity, 2))
        """Expected inverse z-depth in the host and its standard deviation [1/map unit]."""
        self.sigma: FloatArray = np.zeros(capacity)
        """Standard deviation along the ray [map units]."""
        self._free: list[int] = list(range(capacity))
        self._just_removed: list[int] = []

    def __len__(self) -> int:
        return int(self.alive.sum())

    def begin_pass(self) -> None:
        """Free the rows that the last mapping pass removed; they are no longer referenced."""
        self._free.extend(self._just_removed)
        self._just_removed.clear()

    def add(
        self, p_w: FloatArray, words: NDArray[np.uint64], born: int, from_depth: bool, colour: NDArray[np.uint8]
    ) -> IntArray:
        """New anchors from points ``(M, 3)``; returns their ids ``(M,)``."""
        while len(self._free) < len(p_w):
            self._grow()
        ids = np.array([self._free.pop(0) for _ in range(len(p_w))], dtype=np.int64)
        self.p_w[ids] = p_w
        self.words[ids] = words
        self.colour[ids] = colour
        self.born[ids] = born
        self.from_depth[ids] = from_depth
        self.observations[ids] = 0
        self.visible[ids] = 1
        self.found[ids] = 1
        self.normal[ids] = 0.0
        self.max_distance[ids] = 0.0
        self.sigma[ids] = np.inf
        self.alive[ids] = True
        return ids

    def rest_on_prior(self, ids: IntArray, host: int, origin: FloatArray, prior: FloatArray) -> None:
        """Set the depth priors of anchors ``(M,)``.

        Args:
            ids: Anchors, ``from_depth``.
            host: Keyframe id.
            origin: Its camera centre ``(3,)``.
            prior: Expected inverse z-depths in it and their standard deviations ``(M, 2)``.
        """
        self.host[ids] = host
        self.origin[ids] = origin
        self.prior[ids] = prior
        self.sigma[ids] = prior[:, 1] / prior[:, 0] * np.linalg.norm(self.p_w[ids] - origin, axis=1)

    def remove(self, ids: IntArray) -> None:
        """Remove anchors; the caller has removed their observations."""
        ids = np.unique(ids[self.alive[ids]])
        self.alive[ids] = False
        self._just_removed.extend(ids.tolist())

    def confirmed(self, ids: IntArray) -> IntArray:
        """Those of the given anchors that at least two keyframes observe."""
        return ids[self.alive[ids] & (self.observations[ids] >= MIN_OBSERVATIONS)]

    def cloud(self, ids: IntArray) -> PointCloud:
        """Those of the given anchors that at least two keyframes observe; the caller holds the map's lock.

        Where the depth rests on a prior, `sigma` is the prior's: half of the depth or more.
        """
        ids = self.confirmed(ids)
        return PointCloud(
            self.p_w[ids].astype(np.float32),
            self.colour[ids],
            self.sigma[ids].astype(np.float32),
            self.observations[ids].astype(np.int32),
        )

    def _grow(self) -> None:
        old = len(self.alive)
        for name, array in list(vars(self).items()):
            if isinstance(array, np.ndarray):
                setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        self._free.extend(range(old, 2 * old))
