"""The gate: whether a measurement agrees with what is believed, by chi-square of its squared Mahalanobis distance."""

import math

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray, IntArray

CONFIDENCE = 0.99
"""Share of correct measurements that pass; repeated measurements make up for the others."""


def exceedance(distance: float, components: int) -> float:
    """Probability that chi-square of that many components is larger (Abramowitz and Stegun 26.4.4, 26.4.5).

    Example:
        >>> exceedance(3.841, 1), exceedance(5.991, 2), exceedance(7.815, 3)
        (0.05, 0.05, 0.05)
    """
    half, a = 0.5 * max(distance, 0.0), 0.5 if components % 2 else 1.0
    if half > 700.0:  # below the smallest float
        return 0.0
    tail = math.erfc(math.sqrt(half)) if components % 2 else math.exp(-half)
    while a < 0.5 * components:
        tail += half**a * math.exp(-half) / math.gamma(a + 1.0)
        a += 1.0
    return tail


def passes(residual: FloatArray, covariance: FloatArray, confidence: float = CONFIDENCE) -> bool:
    """Whether a residual ``(N,)`` is within its covariance ``(N, N)``; components of infinite variance are left out.

    Example:
        >>> passes(np.array([2.0, 0.5]), np.eye(2)), passes(np.array([2.0, 3.0]), np.eye(2))
        (True, False)
        >>> passes(np.array([2.0, 3.0]), np.diag([1.0, np.inf]))
        True
    """
    known = np.isfinite(np.diag(covariance))
    r = residual[known]
    with np.errstate(over="ignore"):  # a distance beyond the largest number is infinite, and refused
        distance = r @ np.linalg.solve(covariance[np.ix_(known, known)], r)
    return not known.any() or exceedance(float(distance), int(known.sum())) >= 1.0 - confidence


def consistent(residual: FloatArray, covariance: FloatArray, group: IntArray) -> NDArray[np.bool_]:
    """Measurements that agree with the others: the worst one is left out until all the rest pass.

    Args:
        residual: ``(M,)``.
        covariance: Theirs ``(M, M)``.
        group: Number of each row's measurement ``(M,)``.

    Returns:
        Mask of the rows in use ``(M,)``; all of a measurement, or none.

    Example:
        >>> consistent(np.array([0.1, 9.0, -0.2]), np.eye(3), np.array([0, 1, 2]))
        array([ True, False,  True])
    """
    W, used = np.linalg.inv(covariance), np.ones(len(residual), dtype=bool)
    members = [np.flatnonzero(group == g) for g in np.unique(group)]
    while members:
        alone = W @ residual  # by the inverse of a block of W, the innovation of these rows given all others
        distance = [float(alone[m] @ np.linalg.solve(W[np.ix_(m, m)], alone[m])) for m in members]
        chance = [exceedance(d, len(m)) for d, m in zip(distance, members, strict=True)]
        worst = min(range(len(members)), key=lambda k: (chance[k], -distance[k]))
        if chance[worst] >= 1.0 - CONFIDENCE:
            break
        m = members.pop(worst)
        used[m] = False
        W = W - W[:, m] @ np.linalg.solve(W[np.ix_(m, m)], W[m])
    return used
