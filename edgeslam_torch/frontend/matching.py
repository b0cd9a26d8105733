"""Hamming matching of ORB descriptors: guided by a predicted pixel, or between whole frames.

Candidates come from a 2-D KD-tree over keypoint positions, the distance from the descriptors' bits; a KD-tree over
the descriptors themselves, as the paper has it, is slower and finds less (docs/decisions.md, "KD-tree").
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of indices, ``(M,)`` each, one-to-one."""

    query: IntArray
    train: IntArray
    distance: IntArray
    """Hamming distance in bits."""

    def __len__(self) -> int:
        return len(self.query)


EMPTY = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))


def words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Descriptors ``(N, 32)`` bytes as ``(N, 4)`` 64-bit words, for `hamming`."""
    return np.ascontiguousarray(descriptors).view(np.uint64)


def hamming(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> IntArray:
    """Differing bits between rows of ``a`` and ``b``, shape ``(N,)`` from ``(N, 4)`` words.

    Example:
        >>> hamming(np.array([[0, 0, 0, 7]], np.uint64), np.array([[0, 0, 0, 1]], np.uint64))
        array([2])
    """
    return np.bitwise_count(a ^ b).sum(axis=-1, dtype=np.int64)


def pixel_pairs(query_uv: FloatArray, tree: cKDTree, radius_px: FloatArray) -> tuple[IntArray, IntArray]:
    """All pairs (query, keypoint) closer than each query's own radius, as two index arrays."""
    if len(query_uv) == 0 or tree.n == 0:
        return EMPTY.query, EMPTY.train
    pairs = cKDTree(query_uv).sparse_distance_matrix(tree, float(np.max(radius_px)), output_type="ndarray")
    near = pairs["v"] <= radius_px[pairs["i"]]
    return pairs["i"][near], pairs["j"][near]


def best_pairs(query: IntArray, train: IntArray, distance: IntArray, max_hamming: int, ratio: float) -> Matches:
    """One-to-one matches from candidate pairs.

    A query keeps its nearest candidate when that is within ``max_hamming`` and below ``ratio`` times the second
    nearest; a keypoint wanted by several queries goes to the nearest.
    """
    if len(query) == 0:
        return EMPTY
    order = np.lexsort((train, distance, query))
    q, t, d = query[order], train[order], distance[order]
    first = np.r_[True, q[1:] != q[:-1]]
    has_second = np.r_[~first[1:], False] & first
    second = np.full(len(q), np.inf)
    second[np.flatnonzero(has_second)] = d[np.flatnonzero(has_second) + 1]
    keep = first & (d <= max_hamming) & (d <= ratio * second)
    q, t, d = q[keep], t[keep], d[keep]
    order = np.lexsort((q, d, t))
    q, t, d = q[order], t[order], d[order]
    keep = np.r_[True, t[1:] != t[:-1]] if len(t) else np.zeros(0, bool)
    return Matches(q[keep], t[keep], d[keep])


def match_all(a: NDArray[np.uint64], b: NDArray[np.uint64], max_hamming: int, ratio: float) -> Matches:
    """Mutual nearest neighbours between two whole sets of descriptor words (brute force)."""
    if len(a) == 0 or len(b) < 2:
        return EMPTY
    distance = np.zeros((len(a), len(b)), dtype=np.uint16)
    for k in range(a.shape[1]):
        distance += np.bitwise_count(a[:, None, k] ^ b[None, :, k])
    rows = np.arange(len(a))
    nearest = distance.argmin(axis=1)
    best = distance[rows, nearest].astype(np.int64)
    mutual = distance.argmin(axis=0)[nearest] == rows
    distance[rows, nearest] = np.iinfo(np.uint16).max
    second = distance.min(axis=1)
    keep = mutual & (best <= max_hamming) & (best <= ratio * second)
    return Matches(rows[keep], nearest[keep], best[keep])
