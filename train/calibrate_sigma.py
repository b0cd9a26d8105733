"""Calibration of the predicted uncertainty: scale and floor of sigma such that intervals have 68 % and 95 % coverage.

Sigma describes shape, with each image's median error removed: SLAM fits one scale per image to its anchors and models
that scale's uncertainty separately.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.validate import MAX_DEPTH_M, MIN_DEPTH_M, predict_metres
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.types import FloatArray

PIXELS_PER_VIEW = 500


def residuals_and_sigma(
    network: DepthModule, metadata: Metadata, views: Sequence[View], seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Log-depth residuals, each image's median removed, and the head's raw sigma at random valid pixels,
    ``(N,)`` each."""
    rng = np.random.default_rng(seed)
    residuals, sigmas = [], []
    for view in views:
        depth, sigma = predict_metres(network, metadata, view)
        v, u = np.nonzero((view.depth_m > MIN_DEPTH_M) & (view.depth_m < MAX_DEPTH_M))
        if not len(v):
            continue
        pick = rng.integers(len(v), size=min(PIXELS_PER_VIEW, len(v)))
        at = v[pick], u[pick]
        error = np.log(depth[at] / view.depth_m[at])
        residuals.append(error - np.median(error))
        sigmas.append(sigma[at])
    return np.concatenate(residuals), np.concatenate(sigmas)


def coverage(residuals: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Share of the residuals within 1 and 1.96 sigma; 0.683 and 0.95 if calibrated."""
    z = np.abs(residuals) / sigma
    return float((z < 1.0).mean()), float((z < 1.96).mean())


def calibrate_sigma(network: DepthModule, metadata: Metadata, views: Sequence[View]) -> Metadata:
    """Metadata with ``sigma_scale`` and ``sigma_floor`` that bring both coverages closest to nominal."""
    residuals, raw = residuals_and_sigma(network, metadata, views)
    best, best_cost = (1.0, 0.0), np.inf
    for scale in np.geomspace(0.25, 6.0, 28):
        for floor in (0.0, 0.02, 0.04, 0.06, 0.09, 0.12, 0.16, 0.2):
            one, two = coverage(residuals, np.hypot(scale * raw, floor))
            cost = (one - 0.683) ** 2 + (two - 0.95) ** 2
            if cost < best_cost:
                best, best_cost = (float(scale), floor), cost
    return dataclasses.replace(metadata, sigma_scale=best[0], sigma_floor=best[1])
