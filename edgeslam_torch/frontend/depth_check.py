"""Stage 1, depth: plausibility of a depth map's pixels, and rejection of maps with too few plausible ones."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import DepthMap

logger = logging.getLogger(__name__)

DepthFunction = Callable[[np.ndarray, Camera], DepthMap | None]
"""Maps an undistorted image and its camera to depth; None if there is none."""

PLAUSIBLE_M = (0.05, 200.0)
"""Cheap fixed-focus lenses are out of focus below 5 cm. The network's range ends at 100 m for its training focal
length, at 200 m for one twice as long; values beyond are overflows."""
MAX_SIGMA_LOG = 5.0
"""log(150): a depth that uncertain is unknown."""
MIN_SHARE = 0.5
"""Minimum share of plausible pixels. Sky and windows cover part of an image; a network that fails on most of it
cannot be trusted on the rest."""


def usable(depth: DepthMap) -> NDArray[np.bool_]:
    """Pixels whose depth and sigma are finite, positive and plausible, ``(H, W)``."""
    z, sigma = depth.depth_m, depth.sigma_log
    nearest, farthest = (0.0, np.inf) if depth.is_relative else PLAUSIBLE_M
    return np.asarray(
        (z > 0) & np.isfinite(z) & (z >= nearest) & (z <= farthest) & (sigma > 0) & (sigma <= MAX_SIGMA_LOG)
    )


class CheckedDepth:
    """Wraps a depth function and discards implausible pixels and maps.

    Args:
        depth: Function to check.
    """

    def __init__(self, depth: DepthFunction) -> None:
        self.depth = depth
        self.maps = 0
        """Depth maps requested."""
        self.refused = 0
        """Maps with less than `MIN_SHARE` usable pixels."""

    def __call__(self, image: np.ndarray, camera: Camera) -> DepthMap | None:
        """The depth map with NaN where it is not usable; None if too few pixels are."""
        depth = self.depth(image, camera)
        self.maps += 1
        if depth is None:
            return None
        good = usable(depth)
        share = float(good.mean())
        if share < MIN_SHARE:
            self._refuse(share)
            return None
        return depth if share == 1.0 else replace(depth, depth_m=np.where(good, depth.depth_m, np.float32(np.nan)))

    def _refuse(self, share: float) -> None:
        self.refused += 1
        if self.refused == 1:  # log once; repeats would hide everything else
            logger.warning(
                "the depth network's output is unusable (%.0f %% of the pixels are finite and between %g and %g m); "
                "such keyframes are mapped without depth",
                100 * share,
                *PLAUSIBLE_M,
            )

    def warning(self) -> str | None:
        """Warning about rejected maps; None if there were none."""
        if not self.refused:
            return None
        return (
            f"the depth network's output was unusable for {self.refused} of {self.maps} keyframes (most pixels not "
            f"finite or outside {PLAUSIBLE_M[0]:g} to {PLAUSIBLE_M[1]:g} m); they were mapped without depth"
        )
