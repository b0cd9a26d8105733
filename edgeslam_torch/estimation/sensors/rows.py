"""Linear measurements of camera positions, as the sensors give them."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Rows:
    """Linear measurements of positions in world axes [m]: ``D p = measured``."""

    D: FloatArray
    """``(M, K, 3)`` without the scale."""
    measured: FloatArray
    """``(M,)``"""
    white: FloatArray
    """``(M,)`` variances of independent errors."""
    slow: FloatArray
    """``(M, M)`` covariance of correlated errors."""
    common: FloatArray
    """``(M, C)`` change of ``measured`` per standard deviation of each common nuisance parameter."""
    group: IntArray
    """``(M,)`` groups of rows that form one measurement."""
    way: FloatArray
    """``(M,)`` path length of each row [m]."""


def stacked(parts: list[Rows]) -> Rows | None:
    """All measurements together; None without any."""
    if not parts:
        return None
    size = sum(len(part.measured) for part in parts)
    slow, at, groups = np.zeros((size, size)), 0, 0
    group = []
    for part in parts:
        n = len(part.measured)
        slow[at : at + n, at : at + n] = part.slow
        group.append(part.group + groups)
        at, groups = at + n, groups + int(part.group[-1]) + 1
    return Rows(
        np.concatenate([p.D for p in parts]),
        np.concatenate([p.measured for p in parts]),
        np.concatenate([p.white for p in parts]),
        slow,
        np.concatenate([p.common for p in parts]),
        np.concatenate(group),
        np.concatenate([p.way for p in parts]),
    )
