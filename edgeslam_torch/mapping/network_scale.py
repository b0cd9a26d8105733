r"""The depth network as a soft measurement of each keyframe's common depth, so that the map's scale does not drift.

Where the camera turns, all anchors are replaced within a few keyframes that hardly move. The scale of the new ones is
then known to some percent only, and what is lost at one turn is never won back. The network sees every keyframe anew:
what it says is noisy, but does not drift. Its median log depth :math:`d` follows that of the map, :math:`z`, with the
slope :math:`b` that is measured inside keyframes (`fusion/depth_scale.py`),

.. math:: \log d = a + b \log z + n

and the constant is the median over all keyframes: the map keeps its own unit. Inside a keyframe the network has no say
here; each anchor is pulled by the same factor, as strongly as all of them together make one measurement.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.depth_scale import compared
from edgeslam_torch.map.keyframe import Keyframe, NetworkView
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.optim.problem import DepthPriors
from edgeslam_torch.types import FloatArray, IntArray

NOISE_LOG = 0.1
"""Standard deviation of a keyframe's median log network depth around the line: .04 in fr1_xyz, .09 in redkitchen."""
MAX_SIGMAS = 2.0
"""A keyframe that is farther off counts as if it were this far off: Huber's limit."""
MIN_SLOPE = 0.1
"""A network that follows depth by less than a tenth says the same of everything."""
MIN_ANCHORS = 20
"""Triangulated anchors of a keyframe below which its median is noise."""
MIN_KEYFRAMES = 5
"""Keyframes from which on there is a line to be off."""


@dataclass(frozen=True, slots=True)
class NetworkLine:
    """Log network depth [m] as a line over log map depth [map units]."""

    constant: float
    slope: float

    @property
    def sigma_log(self) -> float:
        """Standard deviation of the log map depth that one keyframe's network depth tells."""
        return NOISE_LOG / self.slope

    def excess(self, view: NetworkView) -> float:
        """Log of what the network would have a keyframe's depths multiplied by."""
        limit = MAX_SIGMAS * self.sigma_log
        return float(np.clip((view.log_network - self.constant) / self.slope - view.log_map, -limit, limit))


def network_line(views: list[NetworkView]) -> NetworkLine | None:
    """The line of a map's keyframes; None while they are few, or where the network does not follow depth."""
    if len(views) < MIN_KEYFRAMES:
        return None
    weight = np.array([v.weight for v in views])
    slope = min(float(weight @ [v.slope for v in views]) / max(float(weight.sum()), 1e-12), 1.0)
    if slope < MIN_SLOPE:
        return None
    return NetworkLine(float(np.median([v.log_network - slope * v.log_map for v in views])), slope)


def network_view(slam_map: SlamMap, keyframe: Keyframe) -> NetworkView | None:
    """How a keyframe's network depth compares with the map; None where there is too little to compare."""
    held, z = _triangulated(slam_map, keyframe)
    if keyframe.network_m is None or len(held) < MIN_ANCHORS:
        return None
    network = keyframe.network_m[held]
    ratio = compared(network, z)
    if ratio is None:
        return None
    weight = ratio.points * ratio.depth_spread_log**2
    return NetworkView(float(np.median(np.log(network))), float(np.median(np.log(z))), ratio.slope, weight)


def network_priors(slam_map: SlamMap, anchor: IntArray, keyframes: list[Keyframe]) -> DepthPriors | None:
    """What the network says of the depths in the keyframes of a window, as priors of their anchors.

    Args:
        slam_map: Holds the anchors; its keyframes' views of the network draw the line.
        anchor: ``(A,)`` the window's anchors.
        keyframes: The window's free ones, in the order of its poses; they are compared anew.
    """
    for keyframe in keyframes:
        keyframe.network_view = network_view(slam_map, keyframe)
    pieces = {slam_map.piece_of(k.id) for k in keyframes}  # others have units of their own
    mine = [k for k in slam_map.keyframes.values() if slam_map.piece_of(k.id) in pieces]
    line = network_line([k.network_view for k in mine if k.network_view is not None])
    if line is None:
        return None
    row_of_anchor = np.full(len(slam_map.anchors.alive), -1, dtype=np.int64)
    row_of_anchor[anchor] = np.arange(len(anchor))
    parts = []
    for pose, keyframe in enumerate(keyframes):
        if keyframe.network_view is None:
            continue
        held, z = _triangulated(slam_map, keyframe)
        row = row_of_anchor[keyframe.anchor[held]]
        inside = row >= 0
        row_of_anchor[keyframe.anchor[held]] = -1  # an anchor is pulled once
        inverse_depth = np.exp(-line.excess(keyframe.network_view)) / z[inside]
        sigma = line.sigma_log * np.sqrt(len(held)) / z[inside]
        parts.append((row[inside], np.full(int(inside.sum()), pose), inverse_depth, sigma))
    if not parts:
        return None
    return DepthPriors(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _triangulated(slam_map: SlamMap, keyframe: Keyframe) -> tuple[IntArray, FloatArray]:
    """Keypoints of a keyframe with network depth and a triangulated anchor ``(H,)``, and their depth in the map."""
    if keyframe.network_m is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    held = keyframe.keypoints_with_anchor()
    held = held[~slam_map.anchors.from_depth[keyframe.anchor[held]]]  # others rest on the network already
    p_w = slam_map.anchors.p_w[keyframe.anchor[held]]
    z = (p_w @ keyframe.T_c_w[:3, :3].T + keyframe.T_c_w[:3, 3])[:, 2]
    good = (z > 0) & (keyframe.network_m[held] > 0)
    return held[good], z[good]
