"""Hamming matching of ORB descriptors, guided by predicted pixels or between whole frames.

Candidates come from a grid over keypoint positions, the distance from the descriptors' bits; a KD-tree over the
descriptors, as in the paper, is slower and has a lower recall (docs/decisions/11-no-kd-tree.md).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import IntArray

MAX_HAMMING = 64
"""Maximum distance of two descriptors [bits of 256]; ORB-SLAM2 uses 50 (strict) and 100 (loose)."""
RATIO = 0.85
"""Maximum ratio of the distances of the nearest and the second nearest descriptor (Lowe)."""


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


def best_pairs(
    query: IntArray, train: IntArray, distance: IntArray, max_hamming: int = MAX_HAMMING, ratio: float = RATIO
) -> Matches:
    """One-to-one matches from candidate pairs.

    A query keeps its nearest candidate if it is within ``max_hamming`` and below ``ratio`` times the second nearest;
    of several queries for one keypoint the nearest wins.
    """
    if len(query) == 0:
        return EMPTY
    return Matches(*_best_pairs(query, train, distance, max_hamming, ratio))


@compiled("i8[::1], i8[::1], i8[::1], i8, f8")
def _best_pairs(
    query: IntArray, train: IntArray, distance: IntArray, max_hamming: int, ratio: float
) -> tuple[IntArray, IntArray, IntArray]:
    """`best_pairs` in the order of ``train``; of equally near ones the first index wins."""
    queries, trains, never = query.max() + 1, train.max() + 1, np.iinfo(np.int64).max
    first, second, nearest = np.full(queries, never), np.full(queries, never), np.zeros(queries, np.int64)
    for i in range(len(query)):
        q, t, d = query[i], train[i], distance[i]
        if d < first[q] or (d == first[q] and t < nearest[q]):
            second[q], first[q], nearest[q] = first[q], d, t
        elif d < second[q]:
            second[q] = d
    best, mine = np.full(trains, never), np.full(trains, -1)
    for q in range(queries):
        d, t = first[q], nearest[q]
        if d <= max_hamming and (second[q] == never or d <= ratio * second[q]) and d < best[t]:
            best[t], mine[t] = d, q
    train = np.flatnonzero(mine >= 0)
    return mine[train], train, best[train]


def match_all(
    a: NDArray[np.uint64], b: NDArray[np.uint64], max_hamming: int = MAX_HAMMING, ratio: float = RATIO
) -> Matches:
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
