"""Pixels with directional uncertainty: covariance ``I / inv_sigma^2`` plus the sum of ``slack slack^T``.

A slack is a direction times a standard deviation: along an edge (aperture problem), or along an epipolar line for an
uncertain depth.
"""

import numpy as np

from edgeslam_torch.types import FloatArray


def whitened_information(slack_px: FloatArray, inv_sigma: FloatArray) -> FloatArray:
    """Inverse covariance times ``sigma^2``, as xx, xy, yy ``(3, N)``.

    Args:
        slack_px: ``(N, 2)``, or ``(N, S, 2)`` for several directions [px].
        inv_sigma: ``(N,)`` [1/px].

    Example:
        >>> whitened_information(np.array([[3.0, 0.0]]), np.ones(1)).T.tolist()
        [[0.1, -0.0, 1.0]]
    """
    weights = np.asarray(inv_sigma, dtype=np.float64)
    u, v = np.moveaxis(np.asarray(slack_px, dtype=np.float64).reshape(len(weights), -1, 2), 2, 0) * weights[:, None]
    xx, xy, yy = 1.0 + (u * u).sum(1), (u * v).sum(1), 1.0 + (v * v).sum(1)
    return np.stack([yy, -xy, xx]) / (xx * yy - xy * xy)


def root(information: FloatArray) -> FloatArray:
    """Symmetric root of 2x2 matrices given as xx, xy, yy ``(3, N)``: whitens residuals.

    By Cayley and Hamilton the root of ``A`` is ``(A + sqrt(det A) I) / sqrt(tr A + 2 sqrt(det A))``.
    """
    xx, xy, yy = information
    det = np.sqrt(xx * yy - xy * xy)
    out: FloatArray = np.stack([xx + det, xy, yy + det]) / np.sqrt(xx + yy + 2.0 * det)
    return out
