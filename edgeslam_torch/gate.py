"""The gate: whether a measurement agrees with what is believed, by chi-square of its squared Mahalanobis distance."""

import numpy as np
from scipy.special import chdtri

from edgeslam_torch.types import FloatArray

CONFIDENCE = 0.99
"""Share of correct measurements that pass; repeated measurements make up for the others."""


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
    distance = r @ np.linalg.solve(covariance[np.ix_(known, known)], r)
    return not known.any() or bool(distance <= chdtri(known.sum(), 1.0 - confidence))
