"""Depth on held-out views: the metrics that the recipe prints, and the calibration of the predicted uncertainty.

Scale and floor of sigma are chosen such that intervals have 68 % and 95 % coverage. Sigma describes shape, with each
image's median error removed: SLAM fits one scale per image to its anchors and models that scale's uncertainty apart.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.metrics.depth_error import report_depth
from edgeslam_torch.frontend.depth_check import CONTRADICTION, order_agreement
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.views.augment import View, fitted_view
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.posed import PosedView
from edgeslam_torch.types import DepthMap, FloatArray

MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 10.0
COMPARED = 10
"""Maximum number of views whose labels are compared with the network's depth."""
OTHER_UNIT = 3.0
"""Ratio of labels and network that a foreign place does not explain; units in use are a factor of 4 or more apart."""


@dataclass(frozen=True, slots=True)
class DepthScores:
    """Means over images; relative errors unless a unit is given."""

    abs_rel: float
    """Metric."""
    abs_rel_scaled: float
    """After each image's median is matched."""
    rmse_m: float
    delta1: float
    delta1_scaled: float
    abs_rel_edges: float
    """Metric, Canny edge pixels alone."""
    log_scale_std: float
    """Standard deviation over images of the log median ratio: variation of scale."""

    def metrics(self) -> dict[str, float]:
        """By name, without figures that no image has; ``score`` is what decides."""
        found = {k: v for k, v in dataclasses.asdict(self).items() if math.isfinite(v)}
        return {"score": self.abs_rel_scaled, **found}


def image_tensor(image: NDArray[np.uint8], metadata: Metadata) -> torch.Tensor:
    """BGR uint8 ``(H, W, 3)`` -> normalised RGB ``(3, H, W)`` float32."""
    rgb = image[..., ::-1].astype(np.float32) / 255.0
    normalised = (rgb - np.array(metadata.mean, np.float32)) / np.array(metadata.std, np.float32)
    return torch.from_numpy(np.ascontiguousarray(normalised.transpose(2, 0, 1)))


def predict_metres(network: DepthModule, metadata: Metadata, view: View) -> tuple[FloatArray, FloatArray]:
    """Depth [m] and its sigma (log) at the view's own size, focal length corrected."""
    size = (metadata.input_height, metadata.input_width)
    fitted = fitted_view(view, size)
    image = image_tensor(fitted.image, metadata)[None]
    with torch.no_grad():
        prediction = network.predict_half(image.to(next(network.parameters()).device))
    # The network sees pixels, so what counts is the focal length in its own pixels (input_width of them).
    log_depth = prediction.log_depth[0, 0].cpu().numpy() + np.log(
        np.sqrt(fitted.K[0, 0] * fitted.K[1, 1]) / metadata.focal_px
    )
    log_sigma = (
        prediction.log_sigma[0, 0].cpu().numpy() if prediction.log_sigma is not None else np.zeros_like(log_depth)
    )
    h, w = view.image.shape[:2]
    large = cv2.resize(log_depth, (w, h), interpolation=cv2.INTER_LINEAR)
    return np.exp(large), np.exp(cv2.resize(log_sigma, (w, h), interpolation=cv2.INTER_LINEAR))


def metres_by(network: DepthModule, metadata: Metadata) -> Callable[[PosedView], FloatArray]:
    """The network's depth [m] of every pixel of a view, as a teacher takes it."""
    network.eval()

    def predict(view: PosedView) -> FloatArray:
        return predict_metres(network, metadata, View.without_depth(view.image, view.K))[0]

    return predict


def score(network: DepthModule, metadata: Metadata, views: Sequence[View]) -> DepthScores:
    """Evaluate on views with depth; images without a valid pixel are skipped.

    Raises:
        SourceError: If no image has one.
    """
    was_training = network.training
    network.eval()
    rows = [row for view in views if (row := _scores_of(predict_metres(network, metadata, view)[0], view)) is not None]
    network.train(was_training)
    if not rows:
        raise SourceError(f"no depth between {MIN_DEPTH_M:g} and {MAX_DEPTH_M:g} m in any image to validate on")
    *columns, log_scale = np.array(rows).T
    known = [column[~np.isnan(column)] for column in columns]  # images without edges have no error there
    means = [float(column.mean()) if len(column) else float("nan") for column in known]
    return DepthScores(*[*means, float(np.std(log_scale))])


def contradiction(network: DepthModule, metadata: Metadata, folder: DepthFolder) -> str:
    """How labels contradict a trained network: by their order or their unit; empty if they do not.

    Raises:
        SourceError: If the views that are compared have no labels.
    """
    network.eval()
    views = folder.views
    orders, ratios = [], []
    compared = range(0, len(views), max(1, math.ceil(len(views) / COMPARED)))
    for view in (views[i] for i in compared):
        depth_m, sigma_log = predict_metres(network, metadata, view)
        known = (view.depth_m > 0) & (depth_m > 0)
        if known.any():
            orders.append(order_agreement(DepthMap(depth_m, sigma_log), DepthMap(view.depth_m, sigma_log)))
            ratios.append(np.log(view.depth_m[known] / depth_m[known]).mean())
    if not ratios:
        raise SourceError(f"{folder.name}: no depth in any of {len(compared)} images")
    if np.median(orders) < CONTRADICTION:
        return f"{folder.name}: its depth is larger where the network's is smaller: disparities?"
    factor = math.exp(float(np.median(ratios)))
    if not 1.0 / OTHER_UNIT < factor < OTHER_UNIT:
        return f"{folder.name}: its depth is {factor:.2g} times the network's: is its unit right?"
    return ""


def counted_pixels(view: View) -> NDArray[np.bool_]:
    """Where it has depth that counts ``(H, W)``."""
    return (view.depth_m > MIN_DEPTH_M) & (view.depth_m < MAX_DEPTH_M)


def _scores_of(predicted: FloatArray, view: View) -> tuple[float, ...] | None:
    counted = counted_pixels(view)
    if not counted.any():
        return None
    found = report_depth(predicted, np.where(counted, view.depth_m, 0.0), view.image)
    metric, scaled, edges = found["metric"], found["median_scaled"], found.get("edges_metric")
    at_edges = np.nan if edges is None else edges.abs_rel
    accurate = metric.delta1, scaled.delta1
    return metric.abs_rel, scaled.abs_rel, metric.rmse_m, *accurate, at_edges, float(np.log(scaled.scale))


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
        v, u = np.nonzero(counted_pixels(view))
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
