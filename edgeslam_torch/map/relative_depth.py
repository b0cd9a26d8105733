"""Scale and shift of a relative depth network's inverse depth, from the anchors of one keyframe."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.robust_statistics import robust_sigma, tukey_weight
from edgeslam_torch.types import FloatArray

MIN_ANCHORS = 12
"""Minimum number of anchors; two define the line, the others its residuals."""
TRIALS = 200
"""Pairs of anchors tried: with half of the anchors wrong, all are bad with a probability of 1e-25."""
MAX_SIGMA_LOG = 0.5
"""Maximum spread of the anchors around the line; a third of them then deviate by a factor of 1.6."""
MIN_SIGMA_LOG = 0.02
STEPS = 5


@dataclass(frozen=True, slots=True)
class InverseFit:
    """Inverse depth in the map's unit, ``scale * inverse + shift`` of the network's."""

    scale: float
    shift: float
    sigma_log: float
    """Robust spread of single anchors around the line, relative to their depth."""
    covariance: FloatArray
    """Of scale and shift ``(2, 2)``."""

    def depth(self, relative: FloatArray) -> FloatArray:
        """Depth [map units] of the network's relative depth ``(N,)``; NaN behind the camera."""
        inverse = self.scale / relative + self.shift
        return np.where(inverse > 0, 1.0 / np.where(inverse > 0, inverse, 1.0), np.nan)

    def log_ratio_at(self, relative: FloatArray) -> FloatArray:
        """Log of map units per unit of relative depth at pixels with that ``(N,)``."""
        return np.log(self.depth(relative) / relative)

    def sigma(self, relative: FloatArray) -> FloatArray:
        """Log standard deviation of that depth ``(N,)``: the spread, and the uncertainty of the line."""
        rows = np.stack([1.0 / relative, np.ones_like(relative)], axis=-1)
        line = np.sqrt(np.einsum("...i,ij,...j->...", rows, self.covariance, rows)) * self.depth(relative)
        return np.hypot(self.sigma_log, line)


def fit_inverse(relative: FloatArray, anchor_depth: FloatArray) -> InverseFit | None:
    """Robust line through the inverse depths of network and anchors at the same pixels.

    Least median of squares over pairs of anchors (Rousseeuw 1984), refined with Tukey's weights. Residuals are relative
    to the depth: ``(scale / relative + shift) * depth - 1``.

    Args:
        relative: The network's relative depth ``(A,)``; NaN where it is unknown.
        anchor_depth: Depth of the anchors ``(A,)`` [map units].

    Returns:
        The line; None with fewer than `MIN_ANCHORS`, where they lie on none, or where network and anchors disagree
        about what is nearer.
    """
    usable = np.isfinite(relative) & (relative > 0) & (anchor_depth > 0)
    z = anchor_depth[usable]
    if len(z) < MIN_ANCHORS:
        return None
    rows = np.stack([z / relative[usable], z], axis=1)
    line = _least_median(rows)
    if line is None:
        return None
    spread = MIN_SIGMA_LOG
    for _ in range(STEPS):
        residual = rows @ line - 1.0
        spread = max(robust_sigma(residual), MIN_SIGMA_LOG)
        weighted = rows * tukey_weight(residual, spread)[:, None]
        normal = weighted.T @ rows
        if np.linalg.cond(normal) > 1e12:
            return None
        line = np.linalg.solve(normal, weighted.sum(axis=0))
    if line[0] <= 0.0 or spread > MAX_SIGMA_LOG:
        return None
    return InverseFit(float(line[0]), float(line[1]), spread, spread**2 * np.linalg.inv(normal))


def _least_median(rows: FloatArray) -> FloatArray | None:
    """Scale and shift of the pair of rows that leaves the smallest median residual, of those with a positive scale."""
    rng = np.random.default_rng(len(rows))
    i = rng.integers(0, len(rows), TRIALS)
    j = (i + rng.integers(1, len(rows), TRIALS)) % len(rows)
    pairs = np.stack([rows[i], rows[j]], axis=1)
    good = np.abs(np.linalg.det(pairs)) > 1e-9 * np.prod(np.linalg.norm(pairs, axis=2), axis=1)
    if not good.any():
        return None
    lines = np.linalg.solve(pairs[good], np.ones((int(good.sum()), 2, 1)))[:, :, 0]
    lines = lines[lines[:, 0] > 0]
    if len(lines) == 0:
        return None
    best = np.argmin(np.median(np.abs(rows @ lines.T - 1.0), axis=0))
    return np.asarray(lines[best])
