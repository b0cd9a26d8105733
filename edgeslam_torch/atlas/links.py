"""Verification that a keyframe shows another submap, and the similarity between the two.

The keyframe is relocalised in the other submap like a lost frame (`tracking/relocaliser.py`). This gives its pose there
from hundreds of keypoints, up to scale: keypoints with an anchor in both submaps have two independent depths, whose
ratios must agree. A camera that rotates in place has no such pairs; within one submap the scale is equal then. Finally
the other keyframe, relocalised in the first submap, must confirm the similarity.
"""

from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.atlas.submap_graph import PLACE_LOG, Belief
from edgeslam_torch.gate import passes
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.tracking.relocaliser import (
    LIKELY_SHARE,
    LIKELY_SPREAD,
    Place,
    match_keyframe,
    place_of,
)
from edgeslam_torch.tracking.tracker import Track, Tracker, View
from edgeslam_torch.types import FloatArray, IntArray

MIN_INLIERS = 50
MIN_COMMON = 25
"""Keypoints with a triangulated anchor on both sides."""
AGREE_LOG = 0.15
"""Deviation of a keypoint's log depth ratio from the common scale up to which it agrees: three sigmas of 5 %, the
accuracy of triangulation with one or two degrees of parallax."""
MIN_AGREEING = 0.6
"""Share of those keypoints that must agree on the scale; of unrelated depths a quarter does."""
MAX_SIGMA_LOG = 0.03
"""Standard deviation of the common log scale."""
PLANE_PART, ON_PLANE = 0.9, 0.02
"""Share of the anchors, and their maximum distance from a plane relative to the depth, for a planar scene."""
PLANE_FITS = 5
"""Iterations of the plane fit, each to that share alone."""
PLANE_SHARE = 0.2
"""Share of the anchors in view that must be matched if they lie on one plane: similar floors and walls in other rooms
match with 0.12 to 0.16 (docs/decisions/20-loops.md)."""
LINK_PLACE = 0.024
"""Standard deviation per axis of a camera's centre by a link, relative to the depth."""
LINK_RAD = np.deg2rad(1.2)
"""Standard deviation of its orientation; `LINK_PLACE` at that depth corresponds to 1.4 degrees."""
LINK_LOG = 0.01
"""Standard deviation of the log scale of a link in a bent map, beside that of its depths."""


@dataclass(frozen=True, slots=True)
class Link:
    """A keyframe of one submap seen in another."""

    keyframe: Keyframe
    other: Keyframe
    """Of the other submap."""
    S: FloatArray
    """``(4, 4)`` similarity from the keyframe's submap to the other."""
    sigma_log: float
    """Standard deviation of its log scale, if the two submaps differ by a similarity only."""
    keypoint: IntArray
    """``(M,)`` matched keypoints of the keyframe."""
    anchor: IntArray
    """``(M,)`` their anchors in the other submap."""
    depth: float
    """Median depth of these in the keyframe [units of the other submap]."""
    by_images: bool = True
    """Whether the scale comes from images."""

    def agrees(self, other: "Link") -> bool:
        """Whether another link between the same submaps gives the same pose and scale for this keyframe."""
        here, there = (sim3.moved_camera(S, self.keyframe.T_c_w) for S in (self.S, other.S))
        sigma_log = float(np.linalg.norm([self.sigma_log, other.sigma_log, LINK_LOG]))
        scales = float(np.log(sim3.scale_of(self.S) / sim3.scale_of(other.S)))
        return Belief(LINK_PLACE * self.depth, LINK_RAD, sigma_log).allows_pose(here, there, scales)

    def in_unit(self, sigma_log: float) -> "Link":
        """The same place with the scale that sensors and images have together.

        Sensors measure the unit of whole submaps, images that of one view, which predicted depths may have changed: a
        submap of twelve metres was scaled by 1.6 where the camera had turned before a bare wall. A view that
        contradicts its submap does not count.

        Args:
            sigma_log: Standard deviation of the log scale between the submaps by sensors, which have them in one unit.
        """
        by_image = np.hypot(self.sigma_log, PLACE_LOG)
        both, measured = by_image**2 + sigma_log**2, np.log(sim3.scale_of(self.S))
        share = sigma_log**2 / both if passes(np.array([measured]), np.array([[both]])) else 0.0
        sigma = sigma_log * np.sqrt(1.0 - share)
        change, centre = np.exp((share - 1.0) * measured), self.keyframe.centre_w
        S = self.S @ sim3.compose(change, np.eye(3), (1.0 - change) * centre)
        return replace(self, S=S, sigma_log=float(sigma))


def view_of(keyframe: Keyframe, scale_factor: float) -> View:
    """A keyframe in the form of a frame to be matched."""
    inv_sigma = scale_factor ** -keyframe.features.octave.astype(np.float64)
    return View(keyframe.features, keyframe.words, keyframe.grid, inv_sigma)


def link(
    tracker: Tracker,
    keyframe: Keyframe,
    other: Keyframe,
    min_share: float = LIKELY_SHARE,
    otherwise: tuple[float, float] | None = None,
) -> Link | None:
    """Pose of a keyframe in another keyframe's submap; None unless it is verified.

    Args:
        tracker: Contains the map.
        keyframe: To be located.
        other: Keyframe that may show the same place.
        min_share: Share of the anchors in view that must be matched, in both directions.
        otherwise: Scale of the other submap relative to the keyframe's, and the standard deviation of its log, where
            images have too few depths on both sides; None refuses the link.
    """
    there = _place(tracker, keyframe, other, min_share)
    if there is None:
        return None
    if there.share < PLANE_SHARE and on_one_plane(tracker.map.anchors.p_w[there.track.anchor], there.depth):
        return None
    ratio = log_ratios(tracker, keyframe, there.track)
    by_images = len(ratio) >= MIN_COMMON
    scale = agreed_scale(ratio) if by_images else otherwise
    if scale is None:
        return None
    S = se3.inverse(there.track.T_c_w) @ sim3.compose(scale[0], np.eye(3), np.zeros(3)) @ keyframe.T_c_w
    back = _place(tracker, other, keyframe, min_share)
    expected = sim3.moved_camera(sim3.inverse(S), other.T_c_w)
    if back is None or not Belief(LINK_PLACE * back.depth, LINK_RAD).allows_pose(expected, back.track.T_c_w):
        return None
    track = there.track
    return Link(keyframe, other, S, scale[1], track.keypoint, track.anchor, there.depth, by_images)


def _place(tracker: Tracker, keyframe: Keyframe, other: Keyframe, min_share: float) -> Place | None:
    """Pose of a keyframe in the submap of another, if enough of the view matches."""
    view = view_of(keyframe, tracker.orb.scale_factor)
    track = match_keyframe(tracker, view, other)
    if track is None or track.inliers < MIN_INLIERS:
        return None
    place = place_of(tracker, view, track)
    return place if place.share >= min_share and place.spread >= LIKELY_SPREAD else None


def on_one_plane(p: FloatArray, depth: float) -> bool:
    """Whether `PLANE_PART` of points ``(N, 3)`` at a median depth lie on one plane."""
    part = np.ones(len(p), dtype=bool)
    for _ in range(PLANE_FITS):
        middle = p[part].mean(axis=0)
        normal = np.linalg.svd(p[part] - middle, full_matrices=False)[2][2]
        off = np.abs((p - middle) @ normal)
        part = off <= np.quantile(off, PLANE_PART)
    return bool(np.quantile(off, PLANE_PART) <= ON_PLANE * depth)


def log_ratios(tracker: Tracker, keyframe: Keyframe, track: Track) -> FloatArray:
    """Logarithms ``(C,)`` of the depth in the track's submap over that in the keyframe's own, of keypoints with a
    triangulated anchor in both."""
    anchors = tracker.map.anchors
    own = keyframe.anchor[track.keypoint]
    both = (own >= 0) & ~anchors.from_depth[own] & ~anchors.from_depth[track.anchor]
    z_own = se3.transform(keyframe.T_c_w, anchors.p_w[own[both]])[:, 2]
    z_there = se3.transform(track.T_c_w, anchors.p_w[track.anchor[both]])[:, 2]
    front = (z_own > 0) & (z_there > 0)
    return np.log(z_there[front] / z_own[front])


def agreed_scale(ratio: FloatArray) -> tuple[float, float] | None:
    """Common scale of logarithms of depth ratios ``(C,)`` and the standard deviation of its log; None if they do not
    agree."""
    middle = float(np.median(ratio))
    agreeing = ratio[np.abs(ratio - middle) <= AGREE_LOG]
    sigma = robust_sigma(ratio - middle) / np.sqrt(len(ratio))
    if len(agreeing) < MIN_AGREEING * len(ratio) or sigma > MAX_SIGMA_LOG:
        return None
    return float(np.exp(np.mean(agreeing))), max(sigma, 1e-3)
