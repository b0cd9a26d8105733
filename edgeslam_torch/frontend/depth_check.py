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
"""Maximum standard deviation of log depth, log(150); above, the depth is unknown."""
MIN_SHARE = 0.5
"""Minimum share of plausible pixels. Sky and windows cover part of an image; a network that fails on most of it is
unreliable on the rest."""

ORDER_MAPS, ORDER_SIDE = 5, 48
"""Number of maps whose depth order is compared with another network's, and the side of the compared maps [px]."""
CONTRADICTION = -0.3
"""Rank correlation below which two networks contradict each other. Maps of one scene reach at least 0.5, and at most
-0.5 if near and far are exchanged."""


def usable(depth: DepthMap) -> NDArray[np.bool_]:
    """Pixels whose depth and sigma are finite, positive and plausible, ``(H, W)``."""
    z, sigma = depth.depth_m, depth.sigma_log
    nearest, farthest = (0.0, np.inf) if depth.is_relative else PLAUSIBLE_M
    return np.asarray(
        (z > 0) & np.isfinite(z) & (z >= nearest) & (z <= farthest) & (sigma > 0) & (sigma <= MAX_SIGMA_LOG)
    )


def order_agreement(depth: DepthMap, reference: DepthMap) -> float:
    """Rank correlation of two depth maps of one image, -1 to 1; NaN with too few common pixels."""
    steps = tuple(slice(None, None, max(1, side // ORDER_SIDE)) for side in depth.depth_m.shape)
    known = usable(depth)[steps] & usable(reference)[steps]
    if np.count_nonzero(known) < ORDER_SIDE:
        return float("nan")
    one, two = (m.depth_m[steps][known].argsort().argsort() for m in (depth, reference))
    return float(np.asarray(np.corrcoef(one, two))[0, 1])


class CheckedDepth:
    """Wraps a depth function and discards implausible pixels and maps.

    A function with an attribute ``reference``, another depth function, is compared with it in its first `ORDER_MAPS`
    maps, and rejected while its ``contradiction`` names one in most of them. The map cannot detect this, as it is
    initialised from the same depth.

    Args:
        depth: Function to check.
    """

    def __init__(self, depth: DepthFunction) -> None:
        self.depth = depth
        self.maps = 0
        """Depth maps requested."""
        self.refused = 0
        """Maps with less than `MIN_SHARE` usable pixels."""
        self._contradictions: list[str] = []
        self._said_contradiction = False

    def __call__(self, image: np.ndarray, camera: Camera) -> DepthMap | None:
        """The depth map with NaN at unusable pixels; None if too few are usable."""
        depth = self.depth(image, camera)
        self.maps += 1
        if depth is None:
            return None
        good = usable(depth)
        share = float(good.mean())
        if share < MIN_SHARE:
            self._refuse(share)
            return None
        if said := self.contradiction(depth, image, camera):
            if not self._said_contradiction:
                self._said_contradiction = True
                logger.warning(f"{said}: its depth is not used")
            return None
        return depth if share == 1.0 else replace(depth, depth_m=np.where(good, depth.depth_m, np.float32(np.nan)))

    def contradiction(self, depth: DepthMap, image: np.ndarray, camera: Camera) -> str:
        """How most maps so far, with this one, contradict the reference; empty if they do not."""
        if len(self._contradictions) < ORDER_MAPS and (reference := getattr(self.depth, "reference", None)) is not None:
            said = self.depth.contradiction(depth, image, camera, reference(image, camera))  # type: ignore[attr-defined]
            self._contradictions.append(said)
        return self._contradiction()

    def _contradiction(self) -> str:
        named = [said for said in self._contradictions if said]
        return named[0] if 2 * len(named) > len(self._contradictions) else ""

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
        if contradiction := self._contradiction():
            return f"{contradiction}: its depth is not used"
        if not self.refused:
            return None
        return (
            f"the depth network's output was unusable for {self.refused} of {self.maps} keyframes (most pixels not "
            f"finite or outside {PLAUSIBLE_M[0]:g} to {PLAUSIBLE_M[1]:g} m); they were mapped without depth"
        )
