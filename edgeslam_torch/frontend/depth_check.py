"""Stage 1, depth: which pixels of a depth map can be meant, and maps of which too few can."""

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import DepthMap

logger = logging.getLogger(__name__)

DepthFunction = Callable[[np.ndarray, Camera], DepthMap | None]
"""Undistorted image and its camera to depth; None where nothing can be said."""

PLAUSIBLE_M = (0.05, 200.0)
"""Cheap fixed-focus lenses show nothing sharp nearer than 5 cm. The network's range ends at 100 m for the lens it was
trained with, at 200 m for one twice as long; what lies beyond is an overflow, not a distance."""
MAX_SIGMA_LOG = 5.0
"""A depth that may be wrong by a factor of 150 is none."""
MIN_SHARE = 0.5
"""Of the pixels. Sky and windows take part of a picture; a network that fails on most of it cannot be trusted with the
rest."""


def usable(depth: DepthMap) -> NDArray[np.bool_]:
    """Pixels whose depth and sigma are finite, positive and plausible, ``(H, W)``."""
    z, sigma = depth.depth_m, depth.sigma_log
    nearest, farthest = PLAUSIBLE_M
    return np.asarray((z >= nearest) & (z <= farthest) & (sigma > 0) & (sigma <= MAX_SIGMA_LOG))  # NaN compares false


class CheckedDepth:
    """A depth function that says nothing where the one inside cannot be meant.

    Args:
        depth: Function to check.
    """

    def __init__(self, depth: DepthFunction) -> None:
        self.depth = depth
        self.maps = 0
        """Depth maps asked for."""
        self.refused = 0
        """Maps of which less than `MIN_SHARE` was usable."""

    def __call__(self, image: np.ndarray, camera: Camera) -> DepthMap | None:
        """The depth map with NaN where it is not usable; None when too little is."""
        depth = self.depth(image, camera)
        self.maps += 1
        if depth is None:
            return None
        good = usable(depth)
        share = float(good.mean())
        if share < MIN_SHARE:
            self._refuse(share)
            return None
        return depth if share == 1.0 else DepthMap(np.where(good, depth.depth_m, np.float32(np.nan)), depth.sigma_log)

    def _refuse(self, share: float) -> None:
        self.refused += 1
        if self.refused == 1:  # a hundred alike would hide everything else
            logger.warning(
                "the depth network's output is unusable (%.0f %% of the pixels are finite and between %g and %g m); "
                "such keyframes are mapped without depth",
                100 * share,
                *PLAUSIBLE_M,
            )

    def warning(self) -> str | None:
        """What a run should say about refused maps; None when there were none."""
        if not self.refused:
            return None
        return (
            f"the depth network's output was unusable for {self.refused} of {self.maps} keyframes (most pixels not "
            f"finite or outside {PLAUSIBLE_M[0]:g} to {PLAUSIBLE_M[1]:g} m); they were mapped without depth"
        )
