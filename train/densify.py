"""Sparse map points and a network's own depth to dense depth: the teacher for images without labels.

The network knows shapes between edges, the map knows where the edges are. Their log ratio at the map points, spread
smoothly over the image, corrects the network's depth; far from any point only the image's median ratio is corrected.
"""

import cv2
import numpy as np

from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.augment import View
from edgeslam_torch.train.posed import PosedSequence, PosedView
from edgeslam_torch.train.validate import predict_metres
from edgeslam_torch.types import FloatArray

SCALES = (0.15, 0.06, 0.025)
"""Standard deviations of the spreading, in image widths, coarse to fine."""
SHRINK = (0.3, 0.5, 1.0)
"""Points' worth of doubt at each scale: a correction needs more evidence the finer it is."""
MAX_LOG_RATIO = 0.5
"""Points farther than this from the image's median ratio are hidden or wrong."""


def densify(log_depth: FloatArray, uv: FloatArray, log_z: FloatArray) -> FloatArray:
    """Log depth ``(H, W)`` corrected to pass near map points at pixels ``(N, 2)`` with log depths ``(N,)``."""
    height, width = log_depth.shape
    v = np.clip(np.rint(uv[:, 1]), 0, height - 1).astype(int)
    u = np.clip(np.rint(uv[:, 0]), 0, width - 1).astype(int)
    ratio = log_z - log_depth[v, u]
    median = float(np.median(ratio))
    kept = np.abs(ratio - median) < MAX_LOG_RATIO
    v, u, ratio = v[kept], u[kept], ratio[kept]
    correction = np.full((height, width), median, np.float32)
    count = np.zeros((height, width), np.float32)
    np.add.at(count, (v, u), 1.0)
    for scale, doubt in zip(SCALES, SHRINK, strict=True):
        sigma = scale * width
        rest = np.zeros((height, width), np.float32)
        np.add.at(rest, (v, u), ratio - correction[v, u])
        # A point's share in the middle of its own Gaussian is 1 / (2 pi sigma^2): in these units doubt is in points.
        weight = cv2.GaussianBlur(count, (0, 0), sigma) + doubt / (2 * np.pi * sigma**2)
        correction = correction + cv2.GaussianBlur(rest, (0, 0), sigma) / weight
    return log_depth + correction


def teach(network: FastDepth, metadata: Metadata, sequence: PosedSequence, log_scale: float) -> list[View]:
    """The views of a run with dense depth [m] made from the network's prediction and the run's map points.

    Args:
        network: The network before training.
        metadata: Of the network.
        sequence: The run.
        log_scale: Log of metres per map unit.
    """
    network.eval()
    return [_taught(network, metadata, view, log_scale) for view in sequence.views]


def _taught(network: FastDepth, metadata: Metadata, view: PosedView, log_scale: float) -> View:
    blank = np.zeros(view.image.shape[:2], np.float32)
    depth, _ = predict_metres(network, metadata, View(view.image, blank, view.K))
    dense = densify(np.log(depth), view.uv, np.log(view.z) + log_scale)
    return View(view.image, np.exp(dense).astype(np.float32), view.K)
