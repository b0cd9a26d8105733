"""Verification that a keyframe shows another piece of map, and the similarity between the two pieces.

The keyframe is searched in the other piece as a lost frame is (`tracking/relocaliser.py`), which gives its pose there
on the evidence of hundreds of keypoints. What a pose leaves open is the scale: keypoints that have an anchor on both
sides have two depths, and these must not only tell a scale but agree about it, since they come from two reconstructions
that know nothing of each other. A drone that turns on the spot has no two depths: its own sensors may tell the scale
there. At last the way back must close: the other keyframe, searched in the first piece, has to be where the similarity
says.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.tracking.relocaliser import (
    LIKELY_SHARE,
    LIKELY_SPREAD,
    Place,
    match_keyframe,
    place_of,
    pose_difference,
)
from edgeslam_torch.tracking.tracker import Track, Tracker, View
from edgeslam_torch.types import FloatArray, IntArray

MIN_INLIERS = 50
MIN_COMMON = 25
"""Keypoints with a triangulated anchor on both sides."""
AGREE_LOG = 0.15
"""Difference of a keypoint's two depths from the common scale up to which they agree: three sigmas of 5 %, what
triangulation over one or two degrees is good for."""
MIN_AGREEING = 0.6
"""Share of those keypoints that must agree on the scale; of depths that have nothing to do with each other a quarter
does."""
MAX_SIGMA_LOG = 0.03
"""Standard deviation of the common log scale."""
TOLD_SHARE = 0.2
"""Share of the anchors in view that must be found where the images tell no scale: wallpaper that repeats reaches 0.16
at a wrong place."""
PLANE_PART, ON_PLANE = 0.9, 0.02
"""Part of the anchors within a distance from one plane, relative to the depth, that show no more than that plane."""
PLANE_FITS = 5
"""Fits of the plane, each to that part alone."""
PLANE_SHARE = 0.2
"""Share of the anchors in view that must be found where they lie on one plane: floors and walls with the same paint
look the same in many places, and a patch of one is found in another room with 0.12 to 0.16
(docs/decisions/20-loops.md)."""
MIN_PART = 5
"""Keypoints in a quarter of the view whose median says something."""
MAX_SHIFT = 0.1
"""Distance of two estimates of one camera, relative to the depth that it sees."""
MAX_TURN_RAD = np.deg2rad(5.0)
"""Angle between two estimates of one camera: as much as `MAX_SHIFT` seen at that depth, 6 degrees."""


Told = Callable[[Keyframe, Keyframe], tuple[float, float] | None]
"""Size of the second keyframe's piece relative to the first one's, and the standard deviation of its log, by others
than the images; None where they do not tell."""


@dataclass(frozen=True, slots=True)
class Link:
    """A keyframe of one piece seen in another."""

    keyframe: Keyframe
    other: Keyframe
    """Of the other piece."""
    S: FloatArray
    """``(4, 4)`` similarity that takes the keyframe's piece to the other."""
    sigma_log: float
    """Standard deviation of its log scale, as if the two maps were the same but for a similarity."""
    bend_log: float
    """How far the log scale differs from one part of the image to another: the maps are bent."""
    keypoint: IntArray
    """``(M,)`` keypoints of the keyframe that show ..."""
    anchor: IntArray
    """... these anchors of the other piece."""
    depth: float
    """Median depth that the keyframe sees there [units of the other piece]."""
    by_images: bool = True
    """Whether the images told the scale."""

    def agrees(self, other: "Link") -> bool:
        """Whether another link between the same pieces says the same of where this keyframe is, and how large."""
        here, there = (sim3.moved_camera(S, self.keyframe.T_c_w) for S in (self.S, other.S))
        shift, turn = pose_difference(here, there)
        scales = np.log(sim3.scale_of(self.S) / sim3.scale_of(other.S))
        same = abs(scales) <= 3.0 * float(np.hypot(self.sigma_log, other.sigma_log)) + 0.02
        return bool(same and shift <= MAX_SHIFT * self.depth and turn <= MAX_TURN_RAD)


def view_of(keyframe: Keyframe, scale_factor: float) -> View:
    """A keyframe as a frame to be searched."""
    inv_sigma = scale_factor ** -keyframe.features.octave.astype(np.float64)
    return View(keyframe.features, keyframe.words, keyframe.grid, inv_sigma)


def link(
    tracker: Tracker,
    keyframe: Keyframe,
    other: Keyframe,
    min_share: float = LIKELY_SHARE,
    told: Told = lambda *_: None,
) -> Link | None:
    """A keyframe's place in another keyframe's piece; None unless all of it is proven.

    Args:
        tracker: With the map.
        keyframe: Whose place is sought.
        other: Keyframe that may show the same.
        min_share: Share of the anchors in view that must be found, there and on the way back.
        told: Asked for the scale where the images show too few depths on both sides.
    """
    there = _place(tracker, keyframe, other, min_share)
    if there is None:
        return None
    if there.share < PLANE_SHARE and on_one_plane(tracker.map.anchors.p_w[there.track.anchor], there.depth):
        return None
    common = _common_depths(tracker, keyframe, there.track)
    by_images = len(common.own) >= MIN_COMMON
    if by_images:
        scale = _agreed(keyframe, common)
    else:
        scale = _told(told, keyframe, other) if there.share >= TOLD_SHARE else None
    if scale is None:
        return None
    S = _similarity(keyframe.T_c_w, there.track.T_c_w, scale[0])
    back = _place(tracker, other, keyframe, min_share)
    if back is None:
        return None
    shift, turn = pose_difference(back.track.T_c_w, sim3.moved_camera(sim3.inverse(S), other.T_c_w))
    if shift > MAX_SHIFT * back.depth or turn > MAX_TURN_RAD:
        return None
    track = there.track
    return Link(keyframe, other, S, scale[1], scale[2], track.keypoint, track.anchor, there.depth, by_images)


def _place(tracker: Tracker, keyframe: Keyframe, other: Keyframe, min_share: float) -> Place | None:
    """Where a keyframe is in the piece of another, if it looks as if it were there."""
    view = view_of(keyframe, tracker.orb.scale_factor)
    track = match_keyframe(tracker, view, other)
    if track is None or track.inliers < MIN_INLIERS:
        return None
    place = place_of(tracker, view, track)
    return place if place.share >= min_share and place.spread >= LIKELY_SPREAD else None


def on_one_plane(p: FloatArray, depth: float) -> bool:
    """Whether `PLANE_PART` of some points ``(N, 3)``, seen at a median depth, lie on one plane."""
    part = np.ones(len(p), dtype=bool)
    for _ in range(PLANE_FITS):
        middle = p[part].mean(axis=0)
        normal = np.linalg.svd(p[part] - middle, full_matrices=False)[2][2]
        off = np.abs((p - middle) @ normal)
        part = off <= np.quantile(off, PLANE_PART)
    return bool(np.quantile(off, PLANE_PART) <= ON_PLANE * depth)


@dataclass(frozen=True, slots=True)
class _Depths:
    """Of keypoints with a triangulated anchor on both sides ``(C,)``, in the units of either."""

    own: FloatArray
    there: FloatArray
    keypoint: IntArray


def common_scale(tracker: Tracker, keyframe: Keyframe, track: Track) -> tuple[float, float, float] | None:
    """Size of the track's piece relative to the keyframe's own, the standard deviation of its log, and its bend.

    None where too few depths are known on both sides or they do not agree.
    """
    common = _common_depths(tracker, keyframe, track)
    return _agreed(keyframe, common) if len(common.own) >= MIN_COMMON else None


def _common_depths(tracker: Tracker, keyframe: Keyframe, track: Track) -> _Depths:
    anchors = tracker.map.anchors
    own = keyframe.anchor[track.keypoint]
    both = (own >= 0) & ~anchors.from_depth[own] & ~anchors.from_depth[track.anchor]
    z_own = se3.transform(keyframe.T_c_w, anchors.p_w[own[both]])[:, 2]
    z_there = se3.transform(track.T_c_w, anchors.p_w[track.anchor[both]])[:, 2]
    front = (z_own > 0) & (z_there > 0)
    return _Depths(z_own[front], z_there[front], track.keypoint[both][front])


def _agreed(keyframe: Keyframe, common: _Depths) -> tuple[float, float, float] | None:
    """What the depths say together; None if they do not agree."""
    ratio = np.log(common.there / common.own)
    middle = float(np.median(ratio))
    agreeing = ratio[np.abs(ratio - middle) <= AGREE_LOG]
    sigma = robust_sigma(ratio - middle) / np.sqrt(len(ratio))
    if len(agreeing) < MIN_AGREEING * len(ratio) or sigma > MAX_SIGMA_LOG:
        return None
    bend = _bend(ratio, common.there, keyframe.features.uv[common.keypoint, 0])
    return float(np.exp(np.mean(agreeing))), max(sigma, 1e-3), bend


def _told(told: Told, keyframe: Keyframe, other: Keyframe) -> tuple[float, float, float] | None:
    """The same by others than the images, which know of no bend."""
    found = told(keyframe, other)
    return None if found is None else (*found, 0.0)


def _bend(ratio: FloatArray, depth: FloatArray, u: FloatArray) -> float:
    """Scatter of the log scale between near and far, left and right, beyond that of its keypoints ``(N,)``."""
    far, right = depth > np.median(depth), u > np.median(u)
    quarters = [ratio[(far == f) & (right == r)] for f in (False, True) for r in (False, True)]
    parts = [quarter for quarter in quarters if len(quarter) >= MIN_PART]
    if len(parts) < 2:
        return 0.0
    chance = np.mean([robust_sigma(part - np.median(part)) ** 2 / len(part) for part in parts])
    return float(np.sqrt(max(0.0, np.var([np.median(part) for part in parts], ddof=1) - chance)))


def _similarity(T_c_own: FloatArray, T_c_there: FloatArray, scale: float) -> FloatArray:
    """What takes the world of one pose of a camera, scaled, to the world of its other pose."""
    return se3.inverse(T_c_there) @ sim3.compose(scale, np.eye(3), np.zeros(3)) @ T_c_own
